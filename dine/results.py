"""Where everything lies below the results folder: the one place that knows file names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from dine.config import STAGE1, ClassicalMethod, Config, Corruption, Evidence

CLEAN = "deformation"

KNOWN, UNSEEN = "known", "unseen"
"""Whether a test pair's object is one of those that were trained on."""


def unseen_of(dataset: str) -> str:
    """How test pairs of unseen objects are shown where others are of known ones."""
    return f"{dataset}_{UNSEEN}"


def trained_on(shown: str) -> str:
    """The inverse of :func:`unseen_of`; other names stay as they are."""
    return shown.removesuffix(f"_{UNSEEN}")


PAPER_TABLES = {("deformedtissue", False): 1, ("synbench", False): 2, ("deformedtissue", True): 3}
"""Number of the paper's table by dataset and whether targets are corrupted."""


def condition_key(condition: str, corruption: float | str) -> str:
    """Name of a condition in files: ``deformation``, ``noise_0.03``, ``outliers_25``,
    ``resampled_1``."""
    strength = corruption if isinstance(corruption, str) else f"{corruption:g}"
    return condition if condition == CLEAN else f"{condition}_{strength}"


def _named(name: str) -> property:
    return property(lambda self: self.folder / name)


@dataclass(frozen=True)
class Data:
    """Files that are made of one dataset, in a folder of its own."""

    folder: Path

    raw = _named("raw.json")
    inventory = _named("inventory.csv")
    left_out = _named("left_out.csv")
    pairs = _named("pairs.h5")
    agreement = _named("agreement.json")
    resampled = _named("resampled.h5")
    """Targets of other points for all pairs."""

    def variant(self, condition: str, corruption: float | str) -> Path:
        """Targets of one condition for test pairs."""
        return self.folder / "variants" / f"{condition_key(condition, corruption)}.h5"


@dataclass(frozen=True)
class Network:
    """Files of one training, and of what is done with its network."""

    folder: Path

    model = _named("model.safetensors")
    history = _named("history.csv")
    record = _named("run.json")
    predictions = _named("predictions.h5")
    metrics = _named("metrics.csv")
    point_errors = _named("point_errors.h5")
    calibration = _named("calibration.json")
    calibration_plot = _named("calibration.png")
    prior = _named("prior.safetensors")
    """Of pretrained weights; others are by name in :meth:`Results.prior`."""


@dataclass(frozen=True)
class Results:
    """Paths below ``root``. Wildcards of Snakemake, such as ``{dataset}``, may stand for names."""

    root: Path

    @property
    def config(self) -> Path:
        return self.root / "config.yaml"

    @property
    def report(self) -> Path:
        return self.root / "report.html"

    def log(self, *parts: str) -> Path:
        return self._below("logs", *parts, suffix=".log")

    def benchmark(self, *parts: str) -> Path:
        return self._below("benchmarks", *parts, suffix=".tsv")

    def table(self, name: str, suffix: str) -> Path:
        return self._below("tables", name, suffix=f".{suffix}")

    def figure(self, name: str, suffix: str) -> Path:
        return self._below("figures", name, suffix=f".{suffix}")

    def ablation(self, prior: str) -> Path:
        """The table of one prior alone."""
        return self._below("ablation", prior, "all", suffix=".md")

    def _below(self, *parts: str, suffix: str) -> Path:
        *folders, name = parts
        return self.root.joinpath(*folders, f"{name}{suffix}")

    def data(self, dataset: str) -> Data:
        return Data(self.root / dataset)

    def unseen(self, dataset: str) -> Data:
        """Further objects of a dataset, which nothing is trained on."""
        return Data(self.root / dataset / "unseen")

    def network(self, dataset: str, backbone: str, run: str) -> Network:
        """Of a run: ``stage1`` or ``stage2/<method>``."""
        return Network(self.root / dataset / backbone / run)

    def run(self, dataset: str, backbone: str, method: str) -> Network:
        """The same, by the method's name."""
        return self.network(dataset, backbone, STAGE1 if method == STAGE1 else f"stage2/{method}")

    def fields(self, dataset: str, backbone: str) -> Path:
        """Displacement fields of Stage 1 on the training split."""
        return self.root / dataset / backbone / "dvf.h5"

    def prior(self, dataset: str, backbone: str, prior: str) -> Path:
        return self.root / dataset / backbone / "priors" / f"{prior}.safetensors"

    @property
    def search(self) -> Path:
        return self.root / "lambda" / "lambda.json"

    def search_of(self, backbone: str) -> Path:
        """The search of λ with a backbone of its own."""
        return self.root / "lambda" / backbone / "lambda.json"

    def pretraining_data(self, shape: str) -> Data:
        return Data(self.root / "pretraining" / shape)

    def pretrained(self, backbone: str) -> Network:
        return Network(self.root / "pretraining" / backbone)

    def pretraining_fields(self, backbone: str, shape: str) -> Path:
        return self.root / "pretraining" / backbone / f"fields_{shape}.h5"

    def trial(self, template: str) -> TrialFiles:
        """Of the trial of a prior of one organ."""
        return TrialFiles(self.root / "organ_trial" / template)

    @property
    def trial_tables(self) -> Path:
        """All tables of these trials together; each of them lies beside it."""
        return self._below("organ_trial", "tables", "all", suffix=".md")

    @property
    def evidence(self) -> EvidenceFiles:
        return EvidenceFiles(self.root / "evidence")


@dataclass(frozen=True)
class EvidenceFiles:
    """Files of the evidence."""

    folder: Path

    report = _named("report.html")

    def data(self, dataset: str) -> Data:
        return Data(self.folder / dataset)

    def cell(self, dataset: str, backbone: str, seed: int | str, method: str) -> Network:
        """What one method makes of a dataset's test pairs."""
        return Network(self.folder / dataset / backbone / f"seed{seed}" / method)

    def metrics(self, dataset: str, backbone: str, seed: int | str) -> Path:
        """Of all methods with one backbone and seed."""
        return self.folder / dataset / backbone / f"seed{seed}" / "metrics.csv"

    def search(self, method: str) -> Path:
        return self.folder / "lambda" / f"{method}.json"

    def diagnostics(self, dataset: str, backbone: str, prior: str, suffix: str = "json") -> Path:
        return self.folder / "diagnostics" / dataset / backbone / f"{prior}.{suffix}"

    def examples(self, dataset: str, suffix: str = "png") -> Path:
        return self.folder / dataset / f"examples.{suffix}"


@dataclass(frozen=True)
class TrialFiles:
    """Files of the trial of a prior of one organ."""

    folder: Path

    template = _named("template.ply")
    """The mesh in radii, around the origin."""
    truth = _named("truth.h5")
    """Deformations by other mechanics."""

    def held(self, how: str) -> Path:
        """Numbers of the vertices that simulations are held at, or about."""
        return self.folder / f"held_{how}.txt"

    def fields(self, how: str) -> Path:
        return self.folder / f"fields_{how}.h5"

    def prior(self, how: str) -> Path:
        return self.folder / f"prior_{how}.h5"

    def measured(self, about: str) -> Path:
        """Errors under the conditions of a question."""
        return self.folder / f"{about}.csv"


def conditions(config: Config, dataset: str) -> list[tuple[str, float]]:
    """The corrupted conditions of a dataset, and that of targets with other points."""
    return _conditions(config.datasets[dataset].corruption)


def _conditions(asked: Corruption | Evidence) -> list[tuple[str, float]]:
    found = [(kind, x) for kind in ("noise", "outliers") for x in getattr(asked, kind)]
    return found + ([("resampled", 1.0)] if asked.resampled else [])


def strengths(config: Config, dataset: str) -> list[str]:
    """The conditions of a dataset that come in several strengths, which figures are drawn over."""
    return [
        kind for kind in ("noise", "outliers") if getattr(config.datasets[dataset].corruption, kind)
    ]


def runs(config: Config) -> list[tuple[str, str, str]]:
    """Every evaluated (dataset, backbone, method)."""
    return [
        (dataset, backbone, method)
        for dataset in config.datasets
        for backbone in config.backbones_of(dataset)
        for method in config.methods(backbone)
    ]


def replica(config: Config, backbone: str, seed: int) -> str:
    """Folder of a backbone trained with some seed, below that of its dataset."""
    return backbone if seed == config.seed else f"{backbone}/seed{seed}"


def backbone_and_seed(config: Config, folder: str) -> tuple[str, int]:
    """The inverse of :func:`replica`."""
    backbone, _, seed = folder.partition("/seed")
    return backbone, int(seed) if seed else config.seed


NO_BACKBONE = "none"
"""Backbone of methods without one, which are compared with those of every backbone."""


class EvidenceCell(NamedTuple):
    """One evaluation of the evidence; methods without a backbone have seed 0."""

    dataset: str
    backbone: str
    seed: int
    method: str


def evidence_cells(config: Config) -> list[EvidenceCell]:
    """Every evaluation of the evidence."""
    evidence = config.evidence
    cells = []
    for dataset in [*config.datasets, *evidence.test_sets]:
        trained = config.networks(dataset)
        for name, method in evidence.methods.items():
            if isinstance(method, ClassicalMethod) and trained in (method.datasets or [trained]):
                cells.append(EvidenceCell(dataset, NO_BACKBONE, 0, name))
        for backbone, settings in config.every_backbone.items():
            if trained not in (getattr(settings, "datasets", None) or [trained]):
                continue
            for number, seed in enumerate(evidence.seeds[: getattr(settings, "seeds", None)]):
                names = config.methods(backbone)
                if number:
                    names = [name for name in names if name not in evidence.first_seed_only]
                for name, method in evidence.methods.items():
                    if isinstance(method, ClassicalMethod):
                        continue
                    fits = backbone in (method.backbones or config.backbones)
                    fits &= trained in (method.datasets or [trained])
                    if fits and number < (method.seeds or len(evidence.seeds)):
                        names.append(name)
                cells += [EvidenceCell(dataset, backbone, seed, name) for name in names]
    return cells


def evidence_groups(config: Config) -> dict[tuple[str, str, int], list[EvidenceCell]]:
    """The evaluations that one job makes together, by (dataset, backbone, seed)."""
    groups: dict[tuple[str, str, int], list[EvidenceCell]] = {}
    for cell in evidence_cells(config):
        groups.setdefault(cell[:3], []).append(cell)
    return groups


def evidence_conditions(config: Config, dataset: str) -> list[tuple[str, float]]:
    """The corrupted conditions of the evidence, and that of targets with other points.

    Test sets are corrupted by nothing: their levels are their own.
    """
    found = _conditions(config.evidence)
    own_levels = dataset in config.evidence.test_sets
    return [x for x in found if x[0] == "resampled"] if own_levels else found


def evidence_names(config: Config, kind: type) -> list[str]:
    """Names of the evidence's methods of one kind, such as ``Stage2Method``."""
    return [name for name, method in config.evidence.methods.items() if isinstance(method, kind)]


def pca_priors(config: Config, backbone: str) -> list[str]:
    """The PCA priors used with a backbone, whose spectrum and modes are drawn."""
    return [p for p in config.every_backbone[backbone].priors if config.priors[p].kind == "pca"]


def own_searches(config: Config) -> list[str]:
    """Backbones with which λ is searched besides that of `lambda_search`."""
    first = config.lambda_search.backbone
    return [name for name, b in config.backbones.items() if b.own_lambda and name != first]


def figure_names(config: Config) -> list[str]:
    """Stems of all figures of a run, in the order of the report."""
    names = []
    for dataset in config.datasets:
        kinds = [CLEAN, *strengths(config, dataset)]
        names += [f"distance_{dataset}_{kind}" for kind in kinds]
        for backbone in config.backbones_of(dataset):
            names += [f"{kind}_{dataset}_{backbone}" for kind in ("qualitative", "histogram")]
    names += ["lambda", *(f"lambda_{name}" for name in own_searches(config))]
    for dataset in config.datasets:
        for backbone in config.backbones_of(dataset):
            for prior in pca_priors(config, backbone):
                names += [f"{kind}_{dataset}_{backbone}_{prior}" for kind in ("spectrum", "modes")]
            names.append(f"training_{dataset}_{backbone}")
    return names


def table_name(dataset: str, corrupted: bool) -> str:
    """Stem of a table of Chamfer distances: the paper's number where it has one."""
    number = PAPER_TABLES.get((dataset, corrupted))
    if number:
        return f"table{number}"
    return f"{'corruption' if corrupted else 'deformation'}_{dataset}"


def table_names(config: Config) -> list[str]:
    """Stems of all tables of a run."""
    names = []
    for dataset, settings in config.datasets.items():
        corruption = settings.corruption
        for shown in [dataset, *([unseen_of(dataset)] if _shown_apart(config, dataset) else [])]:
            names.append(table_name(shown, corrupted=False))
            # A number of pairs is of known objects alone.
            if conditions(config, dataset) and (shown == dataset or corruption.pairs is None):
                names += [table_name(shown, corrupted=True), f"observed_{shown}"]
            names.append(f"correspondence_{shown}")
            if any(config.backbones[name].priors for name in config.backbones_of(dataset)):
                names.append(f"gains_{shown}")
    return names


def _shown_apart(config: Config, dataset: str) -> bool:
    """Whether unseen objects are sure to have tables of their own.

    Where all test pairs are of unseen objects they are not told apart, and only a run finds out
    what the split of a user's own data, or a published one, says.
    """
    settings = config.datasets[dataset]
    known = settings.pairs.split.by == "deformation"
    return bool(settings.unseen) and known and settings.source.kind == "synthetic"

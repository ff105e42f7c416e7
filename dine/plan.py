"""What the workflow makes of a configuration: the settings of each step, its files.

A step gets its own section of the configuration as text, with all defaults and nothing else: it is
made again when that changes, and only then. Cheap to import: Snakemake does it for every DAG.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

from dine import config as settings
from dine.config import CONTROL, STAGE1, BackboneConfig, Config, Section
from dine.provenance import code_digest, folder_signature
from dine.results import (
    NO_BACKBONE,
    EvidenceCell,
    Results,
    backbone_and_seed,
    conditions,
    evidence_conditions,
    evidence_groups,
    evidence_names,
    own_searches,
    pca_priors,
    replica,
    runs,
)

# Numbers of synthetic objects far beyond those of any dataset: none is trained and tested on.
FIRST_PRETRAINING_OBJECT = 1_000_000
FIRST_TEST_OBJECT = 2_000_000

PRIOR_TITLES = {"pca": "DINE-PCA", "flow": "DINE-Flow", "pca_residual": "PCA with residual"}
"""What the evidence calls Stage 2 with the priors of `all`, as their tables do."""


def section(model: Section) -> str:
    """One section of the configuration as text."""
    return text(model.model_dump(mode="json", exclude_none=True))


def text(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True)


@dataclass(frozen=True)
class Plan:
    """The default run, pretraining and calibrations. A *folder* is a backbone's, with its seed."""

    config: Config

    @cached_property
    def files(self) -> Results:
        return Results(Path(self.config.results))

    @property
    def whole(self) -> str:
        """All of the configuration that can change a result."""
        everywhere = {"resources": settings.Resources()}
        return section(self.config.model_copy(update=everywhere))

    @property
    def drawn(self) -> str:
        """What the figures need to know; other settings reach them through files, or not at all."""
        drawn = {"datasets", "backbones", "priors", "lambda_search"}
        return text(self.config.model_dump(mode="json", exclude_none=True, include=drawn))

    # --- data

    def raw(self, dataset: str) -> str:
        """Not the split, nor the convention: changing those does not change the raw files."""
        data = self.config.datasets[dataset]
        return text(
            {
                "source": data.source.model_dump(exclude_none=True),
                "recipe": data.recipe.model_dump(),
                "pairs": {"points": data.pairs.points},
            }
        )

    def unseen(self, dataset: str) -> str:
        """As :meth:`raw`, of the further objects."""
        data = self.config.datasets[dataset]
        found: dict[str, Any] = {"pairs": {"points": data.pairs.points}}
        changes = {"pairs_per_level": data.unseen.pairs_per_level}
        if data.unseen.folder is None:
            changes["objects"] = data.unseen.objects
        else:
            found["source"] = {"kind": "path", "folder": data.unseen.folder}
        found["recipe"] = data.recipe.model_copy(update=changes).model_dump()
        return text(found)

    def raw_signature(self, dataset: str) -> str:
        """Changes when a user's own folder does; nobody knows beforehand which files are read."""
        source = self.config.datasets[dataset].source
        return _signature(source.folder if source.kind == "path" else None)

    def unseen_signature(self, dataset: str) -> str:
        return _signature(self.config.datasets[dataset].unseen.folder)

    def raw_files(self, dataset: str) -> dict[str, Path]:
        """The raw files of a dataset, and of its further objects."""
        found = {"raw": self.files.data(dataset).raw}
        if self.config.datasets[dataset].unseen:
            found["unseen"] = self.files.unseen(dataset).raw
        return found

    def variants(self, dataset: str) -> list[Path]:
        return [
            self.files.data(dataset).variant(*condition)
            for condition in conditions(self.config, dataset)
        ]

    def most_corrupted(self, dataset: str) -> list[int]:
        """How many test pairs are corrupted at most; empty for all of them."""
        most = self.config.datasets[dataset].corruption.pairs
        return [most] if most else []

    # --- networks

    def backbone(self, folder: str) -> BackboneConfig:
        return self.config.every_backbone[backbone_and_seed(self.config, folder)[0]]

    def seed(self, folder: str) -> int:
        return backbone_and_seed(self.config, folder)[1]

    def code(
        self,
        step: str,
        folder: str | None = None,
        *,
        data_term: str | None = None,
        priors: Iterable[str] = (),
    ) -> str:
        """Digest of the code behind a step, and of what the configuration picks for it by name."""
        picked = [self.config.priors[prior].kind for prior in priors]
        if folder:
            picked.append(self.backbone(folder).kind)
        if data_term:
            picked.append(data_term)
        return code_digest(step, *picked)

    def network(self, folder: str) -> str:
        return text(self.backbone(folder).model_dump(include={"kind", "arguments"}))

    def stage1(self, folder: str) -> str:
        start = self.backbone(folder).start
        return section(self.config.stage1.model_copy(update={"start": start} if start else {}))

    def prior(self, name: str) -> str:
        prior = self.config.priors[name]
        arguments = settings.check_arguments(prior)
        return text({"kind": prior.kind, "arguments": arguments, "fields": prior.fields})

    def search(self, backbone: str) -> str:
        changes = {"backbone": backbone, "priors": self.config.searched(backbone)}
        return section(self.config.lambda_search.model_copy(update=changes))

    def search_code(self, backbone: str) -> str:
        data_term, priors = self.config.stage2.data_term, self.config.searched(backbone)
        return self.code("search-lambda", backbone, data_term=data_term, priors=priors)

    def searched_priors(self, backbone: str) -> list[Path]:
        """Files of the priors, in the order in which they are searched."""
        dataset = self.config.lambda_search.dataset
        return [
            self.files.prior(dataset, backbone, prior) for prior in self.config.searched(backbone)
        ]

    @property
    def searches(self) -> list[Path]:
        """The searches of λ."""
        own = own_searches(self.config)
        return [self.files.search, *(self.files.search_of(name) for name in own)]

    def search_file(self, folder: str) -> Path:
        """The search of λ that counts for a backbone."""
        name, _ = backbone_and_seed(self.config, folder)
        searching = self.config.searching(name)
        if searching == self.config.lambda_search.backbone:
            return self.files.search
        return self.files.search_of(searching)

    def calibrating(self, folder: str) -> list[str]:
        """The backbone's first PCA prior, if any: what the trust score measures fields with."""
        name, _ = backbone_and_seed(self.config, folder)
        return pca_priors(self.config, name)[:1]

    def calibrating_files(self, dataset: str, folder: str) -> list[Path]:
        return [self.files.prior(dataset, folder, prior) for prior in self.calibrating(folder)]

    # --- pretraining

    @property
    def pretraining_shapes(self) -> list[str]:
        return list(self.config.pretraining.levels)

    def pretraining_raw(self, shape: str) -> str:
        pretraining = self.config.pretraining
        recipe = {
            "shape": shape,
            "objects": pretraining.objects // len(pretraining.levels),
            "levels": pretraining.levels[shape],
            "amplitude": pretraining.amplitude,
        }
        return text({"recipe": recipe})

    @property
    def pretraining_pairs(self) -> str:
        """One convention for both shapes, as one prior is fitted to both."""
        split = self.config.pretraining.split
        return section(settings.Pairs(convention="sphere", split=split))

    def pretrained_kept(self) -> list[Path]:
        found = []
        for shape in self.pretraining_shapes:
            data = self.files.pretraining_data(shape)
            found += [data.raw, data.pairs, data.resampled]
        for backbone in self.config.backbones:
            network = self.files.pretrained(backbone)
            found += [network.model, network.prior, network.calibration]
            found += [
                self.files.pretraining_fields(backbone, shape) for shape in self.pretraining_shapes
            ]
        return found

    # --- all that a target makes on its way, which it names so that a deleted file is made again

    def searches_kept(self) -> list[Path]:
        found = self.searches
        dataset = self.config.lambda_search.dataset
        for backbone in (self.config.lambda_search.backbone, *own_searches(self.config)):
            found += [self.files.fields(dataset, backbone), *self.searched_priors(backbone)]
        return found

    def priors_kept(self) -> list[Path]:
        found = self.searches_kept()
        for dataset in self.config.datasets:
            found += [self.files.data(dataset).pairs, *self.raw_files(dataset).values()]
            for backbone in self.config.backbones_of(dataset):
                priors = self.config.backbones[backbone].priors
                if priors:
                    found.append(self.files.fields(dataset, backbone))
                found += [self.files.prior(dataset, backbone, prior) for prior in priors]
        return found

    def all_kept(self) -> list[Path]:
        found = [self.files.config, *self.priors_kept()]
        for dataset in self.config.datasets:
            found += [self.files.data(dataset).agreement, *self.variants(dataset)]
        for run in runs(self.config):
            network = self.files.run(*run)
            found += [network.model, network.predictions, network.metrics]
        return found

    def calibrations_kept(self) -> list[Path]:
        found = self.priors_kept()
        found += [self.files.data(dataset).resampled for dataset in self.config.datasets]
        for run in runs(self.config):
            network = self.files.run(*run)
            found += [network.model, network.calibration]
        return found

    # --- the trial of a prior of one organ

    @cached_property
    def organ_templates(self) -> dict[str, str]:
        """Meshes by names; the shipped scan, if none are given."""
        given = self.config.organ.templates
        shipped = resources.files("dine") / "scans" / "before.ply"
        return {name: str(Path(path).expanduser()) for name, path in given.items()} or {
            "scan": str(shipped)
        }

    def organ_signature(self, template: str) -> str:
        """Changes when a user's own mesh does, by its size and time."""
        try:
            found = os.stat(self.organ_templates[template]) if self.config.organ.templates else None
        except OSError:
            return ""  # the job says that it is missing
        return f"{found.st_size} {found.st_mtime_ns}" if found else ""

    @property
    def organ_truth(self) -> str:
        organ = self.config.organ
        return text({"deformations": organ.deformations, "edge": organ.edge})

    def organ_simulation(self, how: str) -> str:
        """Held at given vertices exactly, or about them."""
        held = "about" if how == "about" else "exactly"
        return section(self.config.organ.simulation.model_copy(update={"fixed": held}))

    def organ_trial(self, about: str) -> str:
        """Where nothing is changed, all methods are shown, and nothing is simulated anew."""
        organ = self.config.organ
        given = {"simulation": organ.simulation.model_dump(), "compared": organ.compared}
        return text({} if about == "methods" else given)

    @property
    def organ_measured(self) -> list[tuple[str, str]]:
        """Every (template, question)."""
        asked = self.config.organ.questions
        return [(name, about) for name in self.organ_templates for about in asked]

    def organ_kept(self) -> list[Path]:
        found = []
        for template in self.organ_templates:
            files = self.files.trial(template)
            found += [files.template, files.truth]
            for how in ("about", "patch"):
                found += [files.held(how), files.fields(how), files.prior(how)]
        return found


@dataclass(frozen=True)
class EvidencePlan(Plan):
    """The evidence. What a method's files depend on is what the configuration says of it."""

    @cached_property
    def groups(self) -> dict[tuple[str, str, int], list[EvidenceCell]]:
        # Once: to look through all of them for each job would take minutes for thousands of jobs.
        return evidence_groups(self.config)

    def method(self, name: str) -> settings.Method:
        return self.config.evidence.methods[name]

    # --- data

    def has_own_pairs(self, dataset: str) -> bool:
        """Whether the evidence has pairs of its own; otherwise it uses the test pairs of `all`."""
        evidence = self.config.evidence
        if dataset in evidence.test_sets:
            return True
        made = self.config.datasets[dataset].source.kind == "synthetic"
        return made and evidence.test_objects is not None

    def test_raw(self, dataset: str) -> str:
        test_set = self.config.evidence.test_sets.get(dataset)
        data = self.config.datasets[self.config.networks(dataset)]
        found: dict[str, Any] = {"pairs": {"points": data.pairs.points}}
        if test_set:
            found["source"] = {"kind": "path", "folder": test_set.folder}
        else:
            changes = {"objects": self.config.evidence.test_objects, "pairs_per_level": 1}
            found["recipe"] = data.recipe.model_copy(update=changes).model_dump()
        return text(found)

    def test_signature(self, dataset: str) -> str:
        test_set = self.config.evidence.test_sets.get(dataset)
        return _signature(test_set.folder if test_set else None)

    def test_pairs(self, dataset: str) -> str:
        return section(self.config.datasets[self.config.networks(dataset)].pairs)

    def test_raw_files(self, dataset: str) -> list[Path]:
        """The raw files that the pairs of the evidence are made of."""
        if self.has_own_pairs(dataset):
            return [self.files.evidence.data(dataset).raw]
        return list(self.raw_files(dataset).values())

    def test_pairs_file(self, dataset: str) -> Path:
        files = self.files.evidence if self.has_own_pairs(dataset) else self.files
        return files.data(dataset).pairs

    def test_levels(self, dataset: str) -> list[float]:
        """Levels at which targets are corrupted; of test sets all, as these have their own."""
        evidence = self.config.evidence
        return [] if dataset in evidence.test_sets else evidence.at_levels

    def test_variants(self, dataset: str) -> list[Path]:
        data = self.files.evidence.data(dataset)
        return [data.variant(*x) for x in evidence_conditions(self.config, dataset)]

    # --- methods

    def model(self, dataset: str, backbone: str, seed: int, network: str) -> Path:
        folder = replica(self.config, backbone, seed)
        return self.files.run(self.config.networks(dataset), folder, network).model

    def method_code(self, name: str, step: str, folder: str | None = None) -> str:
        method = self.method(name)
        priors = [method.prior] if method.prior else []
        return self.code(step, folder, data_term=method.data_term, priors=priors)

    def method_inputs(self, name: str, dataset: str, folder: str) -> dict[str, Path]:
        """The prior of a Stage-2 method, and the search of its λ unless that is given."""
        method = self.method(name)
        found = {}
        if method.prior:
            found["prior"] = self.files.prior(dataset, folder, method.prior)
            if method.weight is None:
                found["weight"] = self.files.evidence.search(name)
        return found

    def method_stage2(self, name: str) -> str:
        changes = {"data_term": self.method(name).data_term}
        return section(self.config.stage2.model_copy(update=changes))

    def method_search(self, name: str) -> str:
        search = self.config.lambda_search
        named = {"dataset": search.dataset, "backbone": search.backbone, "priors": [name]}
        return text({**named, **self.config.evidence.choice.model_dump()})

    def method_searched(self, name: str) -> Path:
        """The prior whose λ is searched for a method."""
        search = self.config.lambda_search
        return self.files.prior(search.dataset, search.backbone, self.method(name).prior)

    def refined_inputs(self, name: str, dataset: str, backbone: str, seed: int) -> dict[str, Path]:
        method = self.method(name)
        cell = self.files.evidence.cell(dataset, backbone, seed, method.of)
        found = {"predictions": cell.predictions}
        if method.prior:
            folder = replica(self.config, backbone, seed)
            fitted_on = self.config.networks(dataset)
            found["prior"] = self.files.prior(fitted_on, folder, method.prior)
        return found

    # --- results

    def predictions(self, cells: Iterable[EvidenceCell]) -> list[Path]:
        return [self.files.evidence.cell(*cell).predictions for cell in cells]

    def example_cells(self, dataset: str) -> list[EvidenceCell]:
        """What is drawn of a dataset: with the backbone of the search and the first seed."""
        evidence = self.config.evidence
        place = (self.config.lambda_search.backbone, evidence.seeds[0])
        found = {
            cell.method: cell
            for backbone, seed in (place, (NO_BACKBONE, 0))
            for cell in self.groups.get((dataset, backbone, seed), ())
        }
        return [found[name] for name in evidence.examples if name in found]

    def examples(self) -> dict[str, Path]:
        """Pictures of typical pairs, by dataset."""
        datasets = dict.fromkeys(dataset for dataset, _, _ in self.groups)
        return {
            dataset: self.files.evidence.examples(dataset)
            for dataset in datasets
            if self.example_cells(dataset)
        }

    def metrics(self) -> list[Path]:
        return [self.files.evidence.metrics(*group) for group in self.groups]

    def all_searches(self) -> list[Path]:
        methods = {name: self.method(name) for name in self._names(settings.Stage2Method)}
        searched = [name for name, m in methods.items() if m.prior and m.weight is None]
        return [self.files.search, *map(self.files.evidence.search, searched)]

    def _names(self, kind: type) -> list[str]:
        return evidence_names(self.config, kind)

    def diagnosed(self) -> list[tuple[str, str, str]]:
        """Every prior of the evidence on every dataset, for the backbone of the search."""
        used = {getattr(method, "prior", None) for method in self.config.evidence.methods.values()}
        used |= set(self.config.priors_of_stage2)
        return [
            (dataset, self.config.lambda_search.backbone, prior)
            for dataset in self.config.datasets
            for prior in self.config.priors
            if prior in used
        ]

    def evidence_kept(self) -> list[Path]:
        """What the evidence makes on its way; see :meth:`all_kept`."""
        found = self.searches_kept() + [self.files.prior(*prior) for prior in self.diagnosed()]
        for (dataset, backbone, seed), cells in self.groups.items():
            found += [*self.test_raw_files(dataset), self.test_pairs_file(dataset)]
            found += [*self.test_variants(dataset), *self.predictions(cells)]
            if backbone == NO_BACKBONE:
                continue
            trained = self.config.networks(dataset)
            found += [self.files.data(trained).pairs, *self.raw_files(trained).values()]
            for cell in cells:
                found += self._kept_of(cell, replica(self.config, backbone, seed))
        return list(dict.fromkeys(found))

    def _kept_of(self, cell: EvidenceCell, folder: str) -> list[Path]:
        """Network, predictions and prior of one evaluation."""
        trained = self.config.networks(cell.dataset)
        method = self.config.evidence.methods.get(cell.method)
        refined = isinstance(method, settings.RefinedMethod)
        network = method.of if refined else cell.method
        found = self.predictions([cell._replace(method=network)])
        found.append(self.files.run(trained, folder, network).model)
        prior = method.prior if method else cell.method
        if prior in self.config.priors:
            found += [self.files.fields(trained, folder), self.files.prior(trained, folder, prior)]
        return found

    def method_texts(self) -> str:
        """Title, group and description of every method, for the report."""
        known = {
            STAGE1: {
                "title": "Stage 1",
                "group": "network",
                "description": "The network trained on the Chamfer distance alone.",
            },
            CONTROL: {
                "title": "Control (λ = 0)",
                "group": "network",
                "description": "Stage 2 without a prior: same start, steps and seed.",
            },
        }
        for prior in self.config.priors_of_stage2:
            kind = self.config.priors[prior].kind
            known[prior] = {
                "title": PRIOR_TITLES.get(prior, f"DINE-{prior}"),
                "group": "prior",
                "description": f"Stage 2 with the prior {kind}, and the λ of the search for `all`.",
            }
        for name, method in self.config.evidence.methods.items():
            known[name] = {
                "title": method.title or name,
                "group": method.group,
                "description": method.description,
            }
        return text(known)


def _signature(folder: str | None) -> str:
    return folder_signature(Path(folder).expanduser()) if folder else ""

"""The configuration: one typed source, checked before anything runs.

Importing this module is cheap (no torch), since Snakemake does it for every DAG.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from dine.errors import ConfigError

CONTROL = "lambda0"
"""Stage 2 without a prior: same start, same steps, same seed."""

STAGE1 = "stage1"

NAMED = ("datasets", "backbones", "priors")
"""Sections whose keys are names of the user's choice."""

_NOT_YAML = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError)
_MOST_FAULTS = 30
_MOST_VALUES, _DEEPEST = 100_000, 50
_MOST_ELASTIC = 0.25

_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


def _no_bool(value: Any) -> Any:
    # YAML reads `off` and `yes` as booleans, which pydantic would take for 0 and 1.
    if isinstance(value, bool):
        raise ValueError(f"expected a number, found {value}")
    if isinstance(value, str):
        raise ValueError(
            f"expected a number, found the text {value!r} (YAML wants 1.0e-4, not 1e-4)"
        )
    return value


Number = Annotated[float, BeforeValidator(_no_bool)]
Count = Annotated[int, BeforeValidator(_no_bool), Field(ge=1)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Fraction = Annotated[Number, Field(ge=0, le=1)]
Range = Annotated[list[Positive], Field(min_length=2, max_length=2)]
Load = Literal["force", "pressure", "gravity", "shrinkage"]


def most_pairs_per_level(percents: Collection[float], widths: Collection[float]) -> float:
    """Different deformations that a recipe's lists give: no end of them where one is a range."""
    lists = (set(percents), set(widths))
    return math.inf if max(map(len, lists)) > 1 else 1


class Section(BaseModel):
    """Base of all sections: unknown keys are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True, defer_build=True
    )


class Source(Section):
    kind: Literal["synthetic", "path", "doi"] = "synthetic"
    """Where raw meshes come from: generated, a folder of yours, or the published dataset."""
    folder: str | None = None
    """For `path`: the published layout, or undeformed meshes from which targets are made."""
    doi: str | None = None
    """For `doi`: the dataset's DOI."""
    server: str = "https://heidata.uni-heidelberg.de"
    """For `doi`: the Dataverse server."""
    version: str = "1.0"
    """For `doi`: the dataset's version."""

    @model_validator(mode="after")
    def _complete(self):
        if self.kind == "path" and not self.folder:
            raise ValueError("`folder` is needed when `kind` is path")
        if self.kind == "doi" and not self.doi:
            raise ValueError("`doi` is needed when `kind` is doi")
        return self


class Elasticity(Section):
    """What is drawn for deformations by finite elements. Lengths are in radii of the mesh."""

    edge: Positive = 0.1
    """Edge of the cubes."""
    farthest: Positive = 0.6
    """Largest displacement at a place, by linear elasticity; the loads are lessened otherwise."""
    stiffness: Range = [0.5, 2.0]
    """Young's modulus, relative to any, which varies smoothly over the organ."""
    poisson: Annotated[
        list[Annotated[Positive, Field(lt=0.5)]], Field(min_length=2, max_length=2)
    ] = [0.4, 0.48]
    """Poisson ratio."""
    fixed: Literal["exactly", "about"] = "exactly"
    """Whether given vertices are fixed as they are, or a patch with its middle at one of them, as
    where an organ hangs is seldom known exactly."""
    patches: Count = 2
    """Largest number of patches of the surface that are fixed, where none are given."""
    patch: Range = [0.2, 0.5]
    """Radius of a patch."""
    loads: list[Load] = Field(
        default=["force", "force", "gravity", "gravity", "pressure", "shrinkage"], min_length=1
    )
    """Kinds of loads to draw from: on a place of the surface, on all of the organ, across the
    surface at a place, and by heat within it. What is named twice comes twice as often."""
    together: Count = 3
    """Largest number of loads at once."""
    width: Range = [0.3, 0.8]
    """Width of loads on a place."""
    cuts: Annotated[int, Field(ge=0)] = 0
    """Largest number of cuts in a body, from a place of the surface inwards. Their sides no longer
    hold each other, so that loads part them."""
    cut: Range = [0.3, 0.8]
    """How far a cut goes from that place, inwards and along the surface."""

    @model_validator(mode="after")
    def _ordered(self):
        for name, value in self:
            if isinstance(value, list) and name != "loads" and value[0] > value[1]:
                raise ValueError(
                    f"`{name}` goes from {value[0]} down to {value[1]}; expected the lower first"
                )
        return self


class Simulation(Elasticity):
    """Deformations of one organ by finite elements. Lengths are in radii of its mesh."""

    fields: Count = 200
    """Deformations."""
    amplitude: Range = [0.05, 0.25]
    """Mean displacement of the surface; less where a cube would be turned inside out."""
    inclusion: Range = [2.0, 10.0]
    """How many times stiffer an inclusion is, where one is given."""
    shared: Count = 4
    """Deformations that share what is fixed and how stiff it is."""


class Recipe(Section):
    """How deformed targets are made, for `synthetic` and for `path` with undeformed meshes."""

    kind: Literal["kernels", "elastic"] = "kernels"
    """By the published recipe, or by finite elements, which needs closed meshes."""
    shape: Literal["primitives", "tissue"] = "primitives"
    """Synthetic base objects: SynBench-like primitives or DeformedTissue-like 2.5D patches."""
    objects: Count = 34
    """Number of synthetic base objects."""
    levels: list[Positive] = Field(default=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8], min_length=1)
    """Deformation levels; of `elastic` the mean displacement of the surface that loads are to
    bring about, in radii, 0.25 at most."""
    control_percents: list[Positive] = Field(default=[2.0, 5.0, 10.0], min_length=1)
    """Shares of control points, in percent of the sampled points."""
    widths: list[Positive] = Field(default=[0.3, 0.4, 0.5], min_length=1)
    """Widths of the Gaussian radial basis function, on objects of unit radius."""
    amplitude: Positive = 0.1
    """Standard deviation per coordinate of a control displacement at level 1."""
    pairs_per_level: Count = 1
    """Targets per object and level. Their percentages and widths are first those of the two lists,
    then drawn from the ranges that the lists span. Those of `elastic` are the same
    bodies under the same kinds of loads at every level."""
    elastic: Elasticity = Elasticity()
    """For `elastic`: what is drawn."""
    fixed_label: str | None = None
    """For `elastic`: a label of the meshes, NAME or NAME=VALUE, whose vertices do not move; by
    default patches are drawn."""

    @model_validator(mode="after")
    def _elastic(self):
        if self.kind != "elastic":
            return self
        if self.shape == "tissue":
            raise ValueError("`shape: tissue` makes open patches; `kind: elastic` needs an inside")
        if max(self.levels) > _MOST_ELASTIC or len(set(self.levels)) < len(self.levels):
            raise ValueError(
                f"`levels` are {self.levels}; `kind: elastic` expects different ones, parts of the "
                f"radius up to {_MOST_ELASTIC}"
            )
        return self

    @model_validator(mode="after")
    def _combinations(self):
        if self.kind == "elastic":
            return self
        most = most_pairs_per_level(self.control_percents, self.widths)
        if self.pairs_per_level > most:
            raise ValueError(
                f"`pairs_per_level` is {self.pairs_per_level}, but `control_percents` and `widths` "
                f"give only {most:g} different deformations; give one of them two values or more, "
                "from between which further ones are drawn"
            )
        return self


class Split(Section):
    """Shares of objects or deformations; a published split file takes precedence."""

    by: Literal["object", "deformation"] = "object"
    """What is shared out: whole objects (test pairs are of unseen objects), or the deformations of
    each object (test pairs are of known objects, under deformations not trained on)."""
    train: Fraction = 0.7
    """Share to train on."""
    val: Fraction = 0.1
    """Share for the search of λ."""
    test: Fraction = 0.2
    """Share for the tables."""

    @model_validator(mode="after")
    def _sum(self):
        total = self.train + self.val + self.test
        if abs(total - 1) > 1e-6 or min(self.train, self.val, self.test) <= 0:
            raise ValueError(
                f"train, val and test must be positive and add up to 1, found {total:g}"
            )
        return self


class Pairs(Section):
    points: Annotated[Count, Field(ge=16)] = 1024
    """Points per cloud."""
    convention: Literal["sphere", "disc", "lexicographic", "none"] = "sphere"
    """What index i means across objects; see docs/reference/pairs.md."""
    split: Split = Split()


class Corruption(Section):
    """Other targets for the test split; the levels of the paper's Table 3 by default."""

    noise: list[Positive] = [0.01, 0.03, 0.04]
    """Standard deviations of Gaussian noise, in the normalised frame."""
    outliers: list[Positive] = [5.0, 25.0, 45.0]
    """Outliers in percent of the points."""
    resampled: bool = False
    """Also targets whose points were drawn anew, as two scans share none."""
    pairs: Count | None = None
    """At most so many test pairs, evenly spread over levels; of known objects, where there are
    any. By default all."""


class Unseen(Section):
    """Further objects that all pairs are tested on and none trained."""

    objects: Count = 14
    """Number of further synthetic objects."""
    pairs_per_level: Count = 1
    """Targets per object and level."""
    folder: str | None = None
    """For `path` and `doi`: a folder of further objects or pairs, or a list of pairs (CSV)."""


class Dataset(Section):
    source: Source = Source()
    recipe: Recipe = Recipe()
    pairs: Pairs = Pairs()
    corruption: Corruption = Corruption()
    unseen: Unseen | None = None
    """Objects that nothing is trained on, for the question of what generalises."""

    @model_validator(mode="after")
    def _unseen(self):
        if self.unseen is None:
            return self
        if self.source.kind != "synthetic" and self.unseen.folder is None:
            raise ValueError(
                f"`unseen.folder` is needed when `source.kind` is {self.source.kind}: a folder of "
                "objects that are not in the dataset (or `unseen: null`)"
            )
        if self.source.kind == "synthetic" and self.unseen.folder is not None:
            raise ValueError(
                "`unseen.folder` is not used when `source.kind` is synthetic; leave it out"
            )
        return self


class BackboneConfig(Section):
    kind: str = "robust_defreg"
    """A built-in backbone or an import path `package.module:Class`."""
    arguments: dict[str, Any] = {}
    """Keyword arguments of the class."""
    priors: list[str] = ["pca"]
    """Priors whose Stage 2 is trained with this backbone."""
    start: str | None = None
    """In place of `stage1.start`, for this backbone."""
    datasets: list[str] | None = None
    """Datasets that it is trained on; by default all."""
    own_lambda: bool = False
    """Whether λ is searched with this backbone too, in place of the λ found with that of
    `lambda_search`."""


class PriorConfig(Section):
    kind: str = "pca"
    """A built-in prior or an import path `package.module:Class`."""
    arguments: dict[str, Any] = {}
    """Keyword arguments of the class's `fit`."""
    fields: Literal["predicted", "exact", "shuffled"] = "predicted"
    """What it is fitted to: Stage-1 fields (the paper), the true displacements, or, as a prior that
    must be wrong, Stage-1 fields with the points of each in an order of its own."""


class PCAArguments(Section):
    components: Count = 64
    """Principal components n_c; reduced, with a note, when there are fewer samples."""
    shrinkage: Fraction = 0.05
    """Shrinkage of the latent covariance towards a scaled identity."""
    epsilon_std: Positive = 1.0e-6
    """ε_σ, added to the coordinate-wise standard deviation."""
    epsilon_covariance: Positive = 1.0e-3
    """ε_Σ, added to the diagonal of the latent covariance."""


class FlowArguments(Section):
    transforms: Count = 6
    """RealNVP coupling layers."""
    hidden: Count = 256
    """Width of the hidden layers of each coupling."""
    steps: Count = 600
    """Optimiser steps of the maximum-likelihood fit."""
    batch_size: Count = 2048
    """Displacement vectors per step."""
    learning_rate: Positive = 1.0e-3


class PCAResidualArguments(PCAArguments):
    folds: Annotated[Count, Field(ge=2)] = 5
    """Folds of the cross-validation that gives the residual's variance."""


class GaussianProcessArguments(Section):
    widths: list[Positive] = Field(default=[0.2, 0.4, 0.8, 1.6], min_length=1)
    """Widths of the squared exponentials, in the normalised frame; their amplitudes are fitted."""
    rank: Count = 128
    """Rank of the covariance between the points of a source."""
    points: Count = 256
    """Points of each field that the fit looks at."""
    sources: Count = 64
    """Largest number of different sources that the fit looks at."""
    least_noise: Positive = 1.0e-3
    """Smallest standard deviation of what points do independently, in the normalised frame."""


class SmoothnessArguments(Section):
    neighbours: Count = 10
    """Nearest neighbours of each source point that should move like it."""
    anchor: Annotated[Positive, Field(lt=1)] = 0.01
    """Share of the magnitude in the penalty, besides the roughness; makes the density proper."""


class PCAProcessArguments(GaussianProcessArguments, PCAArguments):
    folds: Annotated[Count, Field(ge=2)] = 5
    """Folds of the cross-validation that gives the fields of the residual process."""


class LatentFlowArguments(PCAResidualArguments):
    transforms: Count = 4
    """RealNVP coupling layers."""
    hidden: Count = 64
    """Width of the hidden layers of each coupling."""
    steps: Count = 600
    """Largest number of optimiser steps of the maximum-likelihood fit."""
    patience: Count = 200
    """Steps without a better held-out likelihood after which the fit stops."""
    batch_size: Count = 64
    """Fields per step."""
    learning_rate: Positive = 3.0e-4
    weight_decay: NonNegative = 0.1
    """AdamW's decoupled weight decay."""


class OrganLearning(Section):
    """How the prior of one organ is learned. Lengths are in radii of its mesh."""

    components: Count | None = None
    """Principal components; by default as many as are best for deformations left out."""
    candidates: list[Count] = Field(default=[5, 10, 20, 30, 40, 60, 80, 120], min_length=1)
    """Numbers of components that are tried."""
    folds: Annotated[Count, Field(ge=2)] = 5
    """Parts that are left out in turn."""
    points: Count = 200
    """Vertices that the process is fitted at."""
    edge: Positive = 0.1
    """Edge of the cubes inside, where no simulation comes with some."""
    widths: list[Positive] = Field(default=[0.3, 0.6, 1.2], min_length=1)
    """Widths of the process for what the components miss; its amplitudes are fitted."""
    mismatch: list[NonNegative] = [0.01, 0.0, 0.0]
    """Amplitudes at these widths of what the fields themselves are wrong about, on top."""

    @model_validator(mode="after")
    def _paired(self):
        if len(self.mismatch) != len(self.widths):
            raise ValueError(
                f"`mismatch` has {len(self.mismatch)} entries; expected one for each of the "
                f"{len(self.widths)} `widths`"
            )
        return self


TrialMethod = Literal[
    "unregistered", "rigid", "bcpd", "smooth", "pca", "pca_process", "one_patch", "places_given"
]
TrialQuestion = Literal["methods", "seen", "mechanics", "size"]


class OrganTrial(Section):
    """What a prior of one organ is worth: `snakemake -j2 organ` (docs/guide/organ.md)."""

    templates: dict[str, str] = {}
    """Closed meshes by names; by default the shipped synthetic scan."""
    deformations: Annotated[Count, Field(ge=2)] = 8
    """True deformations under each condition, by other mechanics than the simulations."""
    questions: list[TrialQuestion] = Field(
        default=["methods", "seen", "mechanics", "size"], min_length=1
    )
    """What is changed: nothing; share seen, noise and pose; what simulations are wrong about;
    amplitude."""
    compared: list[TrialMethod] = Field(
        default=["rigid", "bcpd", "smooth", "pca", "pca_process", "places_given"], min_length=1
    )
    """Methods under the conditions of a change; where nothing is changed, all there are."""
    edge: Positive = 0.125
    """Edge of the cubes of these, in radii; that of the simulations should be another."""
    simulation: Simulation = Simulation()
    """Of the deformations that priors are learned of."""
    learning: OrganLearning = OrganLearning()

    @model_validator(mode="after")
    def _named(self):
        for name in self.templates:
            if not _NAME.match(name):
                raise ValueError(
                    f"`templates.{name}` must have a name of lower-case letters, digits and "
                    "underscores, starting with a letter"
                )
        return self


class Training(Section):
    """What every training shares."""

    data_term: str = "chamfer"
    """Data term: `chamfer`, `l1` (needs the true displacement) or an import path."""
    steps: Count = 400
    """Optimiser steps."""
    batch_size: Count = 1
    """Pairs per step, over all processes."""
    learning_rate: Positive = 3.0e-4
    schedule: Literal["constant", "cosine"] = "cosine"
    """Learning rate over the steps; `cosine` falls to a hundredth."""
    warmup: Annotated[int, BeforeValidator(_no_bool), Field(ge=0)] = 0
    """Steps over which the learning rate first rises. AdamW's first steps are as long as the rate
    whatever the gradient, which can throw a trained network out."""
    weight_decay: NonNegative = 0.01
    """AdamW's decoupled weight decay."""
    clip: Positive = 1.0
    """Largest norm of the gradient."""
    validate_every: Count = 100
    """Steps between validations on `validation_pairs`."""
    validation_pairs: Count = 16
    """Validation pairs, spread evenly over the split."""
    keep: Literal["last", "best"] = "last"
    """Weights that a training ends with: the last ones, or `best`, those with the lowest Chamfer
    distance in a validation, of which the start has one, too (early stopping)."""
    save_seconds: Positive = 20.0
    """Longest time between two saved training states."""
    parts: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the steps whose source is cut down to a part; for data terms on displacements."""


class Stage1(Training):
    start: str = "random"
    """`random` (the paper), `pretrained` (the shipped weights) or a file of weights."""


class Stage2(Training):
    steps: Count = 200
    """Optimiser steps."""


class LambdaChoice(Section):
    """How values of λ are compared."""

    candidates: list[Positive] = Field(default=[1.0e-6, 1.0e-5, 1.0e-4, 1.0e-3], min_length=1)
    """Values of λ to try; λ = 0 is always tried too, for comparison."""
    extend: Annotated[int, BeforeValidator(_no_bool), Field(ge=0)] = 3
    """How often the grid may go on where the best value lies at its edge."""
    criterion: Literal["cd", "mce"] = "cd"
    """What the best λ has the lowest mean of: Chamfer distance, or mean correspondence error."""
    tolerance: Annotated[float, Field(ge=0)] = 0.0
    """Share by which a mean may exceed the lowest and count as no worse, since trainings differ by
    chance; the largest λ of these is chosen. 0: the lowest alone."""
    steps: Count = 80
    """Stage-2 steps per candidate."""
    validation_pairs: Count = 24
    """Validation pairs on which the candidates are compared."""

    @model_validator(mode="after")
    def _grid(self):
        if len(set(self.candidates)) < len(self.candidates):
            raise ValueError(f"`candidates` holds a value twice: {self.candidates}")
        if len(self.candidates) == 1 and self.extend:
            raise ValueError(
                f"`candidates` holds the single value {self.candidates[0]:g}, which nothing is "
                "chosen from; give two or more, or set `extend` to 0 to take it as it is"
            )
        return self


class LambdaSearch(LambdaChoice):
    dataset: str = "synbench"
    """Dataset whose validation split decides."""
    backbone: str = "robust_defreg"
    """Backbone that decides."""
    priors: list[str] = Field(default=["pca"], min_length=1)
    """Priors with a λ of their own; the others use the first one's."""


class Evaluation(Section):
    batch_size: Count = 4
    """Pairs per forward pass."""
    training_spread: Fraction = 0.12
    """How much the difference between two methods varies from one training to another (another
    seed, or another CPU's rounding): a standard deviation, as a share of the reference's mean.
    Intervals hold it; docs/results/default-run.md says how it was measured."""
    training_spread_outliers: Fraction = 0.35
    """The same on targets with outliers, where trainings differ more."""


class Pretraining(Training):
    """Weights of our own to start from: L1 on true displacements of synthetic pairs."""

    data_term: str = "l1"
    steps: Count = 4000
    learning_rate: Positive = 1.0e-3
    parts: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of the steps whose source is cut down to a part, as scans often show one."""
    objects: Count = 240
    """Synthetic base objects, half primitives and half tissue patches, none used elsewhere."""
    amplitude: Positive = 0.15
    """Of their deformations, as in `recipe`: somewhat harder than the default datasets."""
    levels: dict[Literal["primitives", "tissue"], list[Positive]] = {
        "primitives": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
        "tissue": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7],
    }
    """Levels of deformation of each shape."""
    split: Split = Split(train=0.9, val=0.05, test=0.05)


class Method(Section):
    """A method of the evidence, besides Stage 1, the control and the priors of each backbone."""

    title: str = ""
    """In tables and figures; by default its name."""
    group: Literal["none", "classical", "prior", "control", "data term", "test time"] = "prior"
    """Where the report lists it."""
    description: str = ""
    """One sentence for the report."""
    datasets: list[str] | None = None
    """Datasets that it is evaluated on; by default all."""


class ClassicalMethod(Method):
    kind: Literal["classical"]
    group: Literal["none", "classical", "test time"] = "classical"
    algorithm: str
    """`unregistered`, `icp`, `cpd`, `bcpd`, `smooth`, or an import path `package.module:Class`."""
    arguments: dict[str, Any] = {}
    """Keyword arguments of the class."""


class NetworkMethod(Method):
    backbones: list[str] | None = None
    """Backbones that it is used with; by default all that are not the evidence's own."""
    seeds: Count | None = None
    """How many of the seeds, from the first on; by default all."""
    prior: str | None = None
    data_term: str = "chamfer"


class Stage2Method(NetworkMethod):
    kind: Literal["stage2"]
    weight: Positive | None = None
    """λ; by default the best of `evidence.choice` on validation pairs."""


class RefinedMethod(NetworkMethod):
    kind: Literal["refined"]
    group: Literal["test time"] = "test time"
    algorithm: Literal["closed_form", "gradient"] = "closed_form"
    """Expectation–maximisation under a Gaussian prior, or by gradient: any data term and prior."""
    of: str = STAGE1
    """The trained network whose field is refined."""
    weight: NonNegative = 0.0
    """λ of `gradient`."""
    arguments: dict[str, Any] = {}
    """`rounds` of the closed form, `steps` and `learning_rate` of the gradient."""


AnyMethod = Annotated[ClassicalMethod | Stage2Method | RefinedMethod, Field(discriminator="kind")]


class EvidenceBackbone(BackboneConfig):
    seeds: Count | None = None
    """How many of the seeds, from the first on; by default all."""


class TestSet(Section):
    """Pairs of known correspondence that nothing is trained on."""

    folder: str
    """Folder in the published layout, or a manifest (CSV): source, target, level and object."""
    networks: str
    """Dataset whose networks, priors and settings of `pairs` are used."""


class Evidence(Section):
    """`snakemake -j2 evidence`: does a prior help, which, and how sure are we?"""

    seeds: list[Annotated[int, BeforeValidator(_no_bool), Field(ge=0, lt=2**31)]] = Field(
        default=[0, 1, 2], min_length=1
    )
    """Seeds of initial weights and training order; the data stay the same."""
    first_seed_only: list[str] = []
    """Priors of the backbones that are trained with the first seed alone."""
    test_objects: Count | None = None
    """Further synthetic objects of each dataset to evaluate on, one deformation of each a level. By
    default, and for data that are not synthetic, the test pairs of `all`."""
    at_levels: list[Positive] = [0.5]
    """Deformation levels at which targets are corrupted or resampled."""
    noise: list[Positive] = [0.03]
    """Standard deviations of Gaussian noise, in the normalised frame."""
    outliers: list[Positive] = [25.0]
    """Outliers in percent of the points."""
    resampled: bool = True
    """Also register to targets whose points were drawn anew, as two scans share none."""
    test_sets: dict[str, TestSet] = {}
    """Further data to evaluate on; shown, but without a say in which method wins."""
    backbones: dict[str, EvidenceBackbone] = {}
    """Backbones for the evidence alone, such as one that starts elsewhere."""
    choice: LambdaChoice = LambdaChoice(criterion="mce")
    """How each method's λ is chosen, on the dataset and backbone of `lambda_search`."""
    methods: dict[str, AnyMethod] = {}
    only: list[str] | None = None
    """Names of the methods to keep; by default all of them."""
    examples: list[str] = [CONTROL]
    """Methods whose fields are drawn for typical pairs; those of the first one are typical."""


class Request(Section):
    """What a job of some kind asks a cluster for; cores and GPUs follow from `threads`, `processes`
    and `device`."""

    memory_mb: Count = 2000
    """Megabytes of main memory, for each process of the job."""
    minutes: Count = 60
    """Longest time; a training that it ends goes on from its saved state when it is run again."""


class TrainingRequest(Request):
    memory_mb: Count = 4000
    """Megabytes of main memory, for each process of the job."""
    minutes: Count = 720
    """Longest time; a training that it ends goes on from its saved state when it is run again."""


class PriorRequest(Request):
    memory_mb: Count = 8000
    """Megabytes of main memory: some six times the size of the file of fields."""


class Resources(Section):
    """What each kind of job asks a cluster for; else without effect (docs/guide/cluster.md)."""

    data: Request = Request()
    """Raw meshes, pairs, corrupted and resampled targets."""
    training: TrainingRequest = TrainingRequest()
    """Stage 1, Stage 2, the search of λ, pretraining."""
    prediction: Request = Request()
    """Networks applied to pairs: fields, predictions, calibrations."""
    prior: PriorRequest = PriorRequest()
    """Fits of priors, and their diagnostics."""
    registration: Request = Request(minutes=240)
    """Classical methods and refinement at test time."""
    evaluation: Request = Request()
    """Metrics from predictions."""
    reporting: Request = Request()
    """Tables, figures, reports."""


class Compute(Section):
    """How a step computes, which is the same for all of them."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` takes a CUDA device where there is one."""
    processes: Count = 1
    """Processes of each training, which share every batch; on CUDA each has its own device."""
    precision: Literal["float32", "bf16"] = "float32"
    """Of the feature network's large products; the rest is always in float32."""


class Config(Compute):
    """The whole configuration."""

    results: str = "results"
    """Folder of all outputs."""
    seed: Annotated[int, BeforeValidator(_no_bool), Field(ge=0, lt=2**31)] = 0
    """Seed of data, initial weights and training order."""
    threads: Count = 1
    """Threads of each process of a training or prediction; Snakemake's -j shares them out."""
    resources: Resources = Resources()
    datasets: dict[str, Dataset] = Field(default={}, min_length=1)
    backbones: dict[str, BackboneConfig] = Field(default={}, min_length=1)
    priors: dict[str, PriorConfig] = Field(default={}, min_length=1)
    stage1: Stage1 = Stage1()
    stage2: Stage2 = Stage2()
    lambda_search: LambdaSearch = LambdaSearch()
    evaluation: Evaluation = Evaluation()
    pretraining: Pretraining = Pretraining()
    evidence: Evidence = Evidence()
    organ: OrganTrial = OrganTrial()

    @model_validator(mode="after")
    def _references(self):
        for section in NAMED:
            for name in getattr(self, section):
                if not _NAME.match(name):
                    raise ValueError(
                        f"the name {name!r} under `{section}` must be lower-case letters, digits "
                        "and underscores, starting with a letter"
                    )
        for name in (STAGE1, CONTROL):
            if name in self.priors:
                raise ValueError(f"a prior cannot be called {name!r}; that name is taken")
        for backbone, settings in self.backbones.items():
            for prior in settings.priors:
                self._known("priors", prior, f"backbones.{backbone}.priors")
            for dataset in settings.datasets or ():
                self._known("datasets", dataset, f"backbones.{backbone}.datasets")
        for name in (*self.datasets, *self.evidence.test_sets):
            if name.endswith("_unseen"):
                raise ValueError(
                    f"a dataset cannot be called {name!r}; the ending stands for unseen objects"
                )
        for name in self.datasets:
            if not self.backbones_of(name):
                raise ValueError(
                    f"no backbone is trained on the dataset {name!r}; add it to the `datasets` of "
                    "one under `backbones`, or take it away"
                )
        search = self.lambda_search
        self._known("datasets", search.dataset, "lambda_search.dataset")
        self._known("backbones", search.backbone, "lambda_search.backbone")
        for name, settings in self.backbones.items():
            trained = settings.datasets or self.datasets
            searches = settings.own_lambda or name == search.backbone
            if searches and search.dataset not in trained:
                raise ValueError(
                    f"λ is searched with the backbone {name!r} on `lambda_search.dataset`, "
                    f"{search.dataset!r}, which is not under `backbones.{name}.datasets`"
                )
        for prior in search.priors:
            self._known("priors", prior, "lambda_search.priors")
        for name, prior in self.priors.items():
            check_arguments(prior, f"priors.{name}.arguments")
        self._check_evidence()
        for stage in ("stage1", "stage2"):
            batch_size = getattr(self, stage).batch_size
            check_shares(batch_size, self.processes, f"{stage}.batch_size")
        return self

    def _known(self, section: str, name: str, where: str) -> None:
        known = getattr(self, section)
        if name not in known:
            raise ValueError(
                f"`{where}` names {name!r}, which is not under `{section}` "
                f"(there: {', '.join(known)})"
            )

    def _check_evidence(self) -> None:
        for name, backbone in self.evidence.backbones.items():
            self._check_evidence_backbone(name, backbone)
        for name, data in self.evidence.test_sets.items():
            if name in self.datasets or not _NAME.match(name):
                raise ValueError(
                    f"`evidence.test_sets.{name}` must have a name of its own, of lower-case "
                    "letters, digits and underscores"
                )
            self._known("datasets", data.networks, f"evidence.test_sets.{name}.networks")
        taken = {STAGE1, CONTROL, *self.priors_of_stage2}
        for name, method in self.evidence.methods.items():
            if name in taken or not _NAME.match(name):
                raise ValueError(
                    f"`evidence.methods.{name}` must have a name of its own, of lower-case letters,"
                    f" digits and underscores; taken are {', '.join(sorted(taken))}"
                )
            self._check_method(method, f"evidence.methods.{name}")
        # A prior that no backbone is trained with is not drawn, as a method that was taken away.
        known = {*taken, *self.priors, *self.evidence.methods}
        unknown = [name for name in self.evidence.examples if name not in known]
        if unknown:
            raise ValueError(
                f"`evidence.examples` names {unknown[0]!r}, which is no method; expected some of "
                f"{', '.join(sorted(known))}"
            )

    def _check_evidence_backbone(self, name: str, backbone: EvidenceBackbone) -> None:
        where = f"evidence.backbones.{name}"
        if name in self.backbones or not _NAME.match(name):
            raise ValueError(
                f"`{where}` must have a name of its own, of lower-case letters, digits and "
                "underscores"
            )
        if backbone.own_lambda:
            raise ValueError(
                f"`{where}.own_lambda` cannot be set: the evidence takes the λ of "
                "`lambda_search`; move the backbone to `backbones`, or leave this out"
            )
        for prior in backbone.priors:
            self._known("priors", prior, f"{where}.priors")
        for dataset in backbone.datasets or ():
            self._known("datasets", dataset, f"{where}.datasets")

    def _check_method(self, method: AnyMethod, where: str) -> None:
        for dataset in method.datasets or ():
            self._known("datasets", dataset, f"{where}.datasets")
        if isinstance(method, ClassicalMethod):
            return
        for backbone in method.backbones or ():
            if backbone not in self.every_backbone:
                raise ValueError(
                    f"`{where}.backbones` names {backbone!r}, which is neither under "
                    "`backbones` nor under `evidence.backbones`"
                )
        if method.prior is not None:
            self._known("priors", method.prior, f"{where}.prior")
        methods = self.evidence.methods.items()
        stage2 = [name for name, other in methods if isinstance(other, Stage2Method)]
        trained = {STAGE1, CONTROL, *stage2}
        if isinstance(method, RefinedMethod) and method.of not in trained:
            raise ValueError(
                f"`{where}.of` is {method.of!r}; expected one of {', '.join(sorted(trained))}"
            )

    def backbones_of(self, dataset: str) -> list[str]:
        """The backbones that are trained on a dataset, those of the evidence apart."""
        return [
            name
            for name, settings in self.backbones.items()
            if dataset in (settings.datasets or self.datasets)
        ]

    def searching(self, backbone: str) -> str:
        """The backbone whose search of λ counts for a backbone."""
        own = self.every_backbone[backbone].own_lambda
        return backbone if own else self.lambda_search.backbone

    def searched(self, backbone: str) -> list[str]:
        """The priors whose λ is searched with a backbone: those that it counts for."""
        used = {
            prior
            for name, settings in self.every_backbone.items()
            if self.searching(name) == backbone
            for prior in settings.priors
        }
        first, *others = self.lambda_search.priors
        # The first one's λ is that of all priors that are not listed.
        return [first, *(prior for prior in others if prior in used)]

    @property
    def every_backbone(self) -> dict[str, BackboneConfig]:
        """All backbones, those of the evidence last."""
        return {**self.backbones, **self.evidence.backbones}

    def networks(self, dataset: str) -> str:
        """The dataset whose networks are evaluated on a dataset: itself, but for test sets."""
        test_set = self.evidence.test_sets.get(dataset)
        return test_set.networks if test_set else dataset

    @property
    def priors_of_stage2(self) -> list[str]:
        """Priors whose Stage 2 has the λ of `lambda_search`."""
        return list(dict.fromkeys(p for b in self.every_backbone.values() for p in b.priors))

    def methods(self, backbone: str) -> list[str]:
        """What is evaluated for a backbone: Stage 1, the control, then its priors."""
        return [STAGE1, CONTROL, *self.every_backbone[backbone].priors]


def check_shares(batch_size: int, processes: int, where: str = "batch_size") -> None:
    """Every process takes as many pairs of a batch as the others."""
    if batch_size % processes:
        raise ValueError(
            f"`{where}` is {batch_size}, which {processes} processes cannot share equally; make it "
            "a multiple of `processes`"
        )


PRIOR_ARGUMENTS: dict[str, type[Section]] = {
    "pca": PCAArguments,
    "flow": FlowArguments,
    "pca_residual": PCAResidualArguments,
    "pca_process": PCAProcessArguments,
    "gaussian_process": GaussianProcessArguments,
    "smoothness": SmoothnessArguments,
    "latent_flow": LatentFlowArguments,
}


def check_arguments(prior: PriorConfig, where: str = "arguments") -> dict[str, Any]:
    """Complete arguments of a prior: defaults filled in for the built-in kinds."""
    model = PRIOR_ARGUMENTS.get(prior.kind)
    if model is None:
        if ":" not in prior.kind:
            raise ValueError(
                f"`{where.removesuffix('.arguments')}.kind` is {prior.kind!r}; expected one of "
                f"{', '.join(PRIOR_ARGUMENTS)} or an import path 'package.module:Class'"
            )
        return dict(prior.arguments)
    try:
        return model.model_validate(prior.arguments).model_dump()
    except ValidationError as error:
        raise ValueError(explain(error, where)) from None


def explain(error: ValidationError, where: str = "") -> str:
    """One line for each fault of a configuration: key, value, what was expected."""
    lines = []
    for fault in error.errors():
        key = ".".join([where, *map(str, fault["loc"])] if where else map(str, fault["loc"]))
        value = _short(fault["input"])
        if fault["type"] == "extra_forbidden":
            lines.append(f"`{key}` is not a known key (value {value}); check the spelling")
        elif fault["type"] == "missing":
            lines.append(f"`{key}` is missing")
        elif fault["type"] == "value_error":
            text = str(fault["ctx"]["error"])
            lines.append(f"`{key}`: {text}" if key else text)
        else:
            lines.append(f"`{key}` is {value}: {fault['msg'][0].lower()}{fault['msg'][1:]}")
    more = f"; and {len(lines) - _MOST_FAULTS} more" if len(lines) > _MOST_FAULTS else ""
    return " ".join(f"{'; '.join(lines[:_MOST_FAULTS])}{more}".split())


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}…"


def validate(values: Any, where: str = "the configuration") -> Config:
    """Check a mapping and fill in defaults.

    A dataset, backbone, prior or method that is null is left out: that is how a file laid over
    another one takes entries away. The evidence then forgets the first three, and what needs them.

    Raises:
        ConfigError: every fault, with key, value and what was expected.
    """
    if isinstance(values, dict):
        gone = {
            key: {name for name, entry in section.items() if entry is None}
            for key in NAMED
            if isinstance(section := values.get(key), dict)
        }
        evidence = values.get("evidence")
        methods = evidence.get("methods") if isinstance(evidence, dict) else None
        if isinstance(methods, dict):
            only = evidence.get("only")
            methods = _only(methods, only) if isinstance(only, list) else methods
            values = {**values, "evidence": {**evidence, "methods": methods}}
            gone["methods"] = {name for name, entry in methods.items() if entry is None}
        values = {key: _without_null(key, section) for key, section in values.items()}
        _forget(values.get("evidence"), gone)
        if isinstance(values.get("backbones"), dict):
            # A prior that a backbone names must be there.
            lost = {"datasets": gone.get("datasets", set())}
            values["backbones"] = _left(values["backbones"], lost)
    return validate_section(Config, values, where)


def _only(methods: dict[str, Any], kept: list[Any]) -> dict[str, Any]:
    """The methods with None for those that are not kept.

    Raises:
        ConfigError: one that is to be kept is not there.
    """
    for name in kept:
        if not isinstance(name, str) or name not in methods:
            raise ConfigError(
                f"`evidence.only` names {name!r}, which is not under `evidence.methods` "
                f"(there: {', '.join(map(str, methods))})."
            )
    return {name: entry if name in kept else None for name, entry in methods.items()}


def _without_null(key: str, section: Any) -> Any:
    if not isinstance(section, dict):
        return section
    if key == "evidence":
        return {inner: _without_null(inner, entry) for inner, entry in section.items()}
    if key in (*NAMED, "methods", "test_sets"):
        return {name: entry for name, entry in section.items() if entry is not None}
    return section


def _forget(evidence: Any, gone: dict[str, set[str]]) -> None:
    """Take away from the evidence what was taken away elsewhere, in place."""
    if not isinstance(evidence, dict):
        return
    for section in ("test_sets", "backbones", "methods"):
        entries = evidence.get(section)
        if isinstance(entries, dict):
            evidence[section] = _left(entries, gone)
            if section == "methods":
                gone.setdefault(section, set()).update(entries.keys() - evidence[section])
    if isinstance(evidence.get("examples"), list):
        lost = gone.get("methods", set()) | gone.get("priors", set())
        evidence["examples"] = [x for x in evidence["examples"] if not _is_gone(x, lost)]


def _left(entries: dict[str, Any], gone: dict[str, set[str]]) -> dict[str, Any]:
    """The entries that do without what was taken away, and without its name."""
    kept = {}
    for name, entry in entries.items():
        if isinstance(entry, dict):
            needed = (("prior", "priors"), ("networks", "datasets"))
            if any(_is_gone(entry.get(key), gone.get(section, ())) for key, section in needed):
                continue
            lists = {key: entry[key] for key in NAMED if isinstance(entry.get(key), list)}
            less = {k: [x for x in v if not _is_gone(x, gone.get(k, ()))] for k, v in lists.items()}
            # Priors are what a backbone is tried with; without datasets nothing is left.
            if any(lists[key] and not less[key] for key in less if key != "priors"):
                continue
            entry = {**entry, **less}
        kept[name] = entry
    return kept


def _is_gone(name: Any, gone: Collection[str]) -> bool:
    return isinstance(name, str) and name in gone


def validate_section(model: type[Section], values: Any, where: str):
    """Check one section, such as a command's settings, against its model."""
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: expected keys and values, found {type(values).__name__}.")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{where}: {explain(error)}.") from None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """A YAML file's mapping, read without running any code.

    Raises:
        ConfigError: missing, unreadable, or not a mapping.
    """
    try:
        values = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}.") from error
    # Values that look like a date or a number and are none raise what their constructors do.
    except (yaml.YAMLError, *_NOT_YAML) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not valid YAML: {reason[:300]}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected keys and values, found {type(values).__name__}.")
    _check_extent(values, path)
    return values


def _check_extent(values: dict[str, Any], path: str | Path) -> None:
    """Refuse what anchors make endless or huge."""
    waiting: list[tuple[Any, int]] = [(values, 0)]
    seen = 0
    while waiting:
        value, depth = waiting.pop()
        seen += 1
        if seen > _MOST_VALUES or depth > _DEEPEST:
            raise ConfigError(
                f"{path} holds more than {_MOST_VALUES} values or is nested more than {_DEEPEST} "
                "deep, its anchors followed; write them out."
            )
        if isinstance(value, dict | list):
            inner = value.values() if isinstance(value, dict) else value
            waiting += [(item, depth + 1) for item in inner]


def merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes`` laid over it, section by section, as Snakemake does."""
    merged = dict(base)
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def load(*paths: str | Path) -> Config:
    """Read configuration files, later ones laid over earlier ones, and check the result."""
    values: dict[str, Any] = {}
    for path in paths:
        values = merge(values, read_yaml(path))
    return validate(values, " + ".join(map(str, paths)))

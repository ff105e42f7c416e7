"""Stage 2 and the search of λ, from files to files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from dine.config import CONTROL, LambdaSearch, Stage2
from dine.errors import ConfigError, DataError
from dine.files import file_digest, read_json, write_json
from dine.models.checkpoint import load_backbone
from dine.priors import load_prior
from dine.results import Network
from dine.training.data_terms import DATA_TERMS
from dine.training.loop import VALIDATION_COLUMNS
from dine.training.objective import Objective
from dine.training.stages import Order, Start, run


def selected_lambda(path: Path, prior: str) -> float:
    """λ for a prior, from the file of the search.

    Raises:
        DataError: the file is not a search's result.
    """
    result = read_json(path)
    try:
        selected = result["selected"]
        weight = float(selected.get(prior, selected[result["default"]]))
        if not 0 <= weight < math.inf:
            raise ValueError("λ is no number from 0 on")
        return weight
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise DataError(f"{path} is not the result of `dine search-lambda`.") from None


def stage2(
    pairs: Path,
    model: Path,
    settings: Stage2,
    order: Order,
    *,
    variant: str,
    prior: Path | None,
    weight: float,
) -> None:
    """Refine a Stage-1 model with λ times a frozen prior.

    ``lambda0`` is the control without; other variants without a prior differ in the data term.
    """
    if variant == CONTROL and prior is not None:
        raise ConfigError(f"The variant {variant!r} takes no prior.")
    backbone, facts = load_backbone(model)
    penalised = load_prior(prior) if prior else None
    described = {"stage": 2, "variant": variant, "lambda": weight, "backbone": facts["backbone"]}
    inputs = {
        "model": file_digest(model),
        "prior": file_digest(prior) if prior else None,
        "lambda": weight,
    }
    objective = Objective(DATA_TERMS.get(settings.data_term)(), penalised, weight)
    run(Start("stage2", backbone, objective, inputs, described), settings, order, [pairs])


Errors = dict[str, float]
"""Mean errors on validation pairs, by name."""


def search_lambda(
    pairs: Path,
    model: Path,
    priors: dict[str, Path],
    stage: Stage2,
    search: LambdaSearch,
    order: Order,
) -> None:
    """Try each λ on a shortened Stage 2 and choose by the criterion's mean on validation pairs.

    ``best_lambda`` chooses; where its choice lies at the edge of the grid, the grid goes on
    there, at most ``search.extend`` times for each prior. λ = 0 is trained too, once, for
    comparison, but never chosen. Each candidate's result is kept, so that an interrupted
    search goes on with the next one. The result, ``order.out``, is a file (JSON).
    """
    settings = _shortened(stage, search)
    folder = order.out.with_name(f"{order.out.stem}_candidates")

    def errors(prior: str, weight: float) -> Errors:
        name = f"{prior}_{weight:g}"
        asked = replace(order, out=folder / name, name=f"{order.name}: {prior} {weight:g}")
        file = priors.get(prior)
        stage2(pairs, model, settings, asked, variant=prior, prior=file, weight=weight)
        final = read_json(Network(asked.out).record)["final"]
        return {name.removeprefix("val_"): final[name] for name in VALIDATION_COLUMNS}

    control = errors(CONTROL, 0.0)
    curve, selected = [], {}
    for prior in priors:
        tried = _tried(partial(errors, prior), search)
        selected[prior] = _best(tried, search)
        # The control is every prior's value at λ = 0.
        rows = {0.0: control, **dict(sorted(tried.items()))}
        curve += [{"prior": prior, "lambda": weight, **found} for weight, found in rows.items()]
    write_json(
        order.out,
        {
            "dataset": search.dataset,
            "backbone": search.backbone,
            "default": next(iter(priors)),
            "selected": selected,
            "criterion": search.criterion,
            "tolerance": search.tolerance,
            "curve": curve,
            "steps": search.steps,
            "validation_pairs": search.validation_pairs,
            "seed": order.seed,
        },
    )


def _shortened(stage: Stage2, search: LambdaSearch) -> Stage2:
    """Stage 2 of a candidate: one validation, at the end, on more pairs than training looks at.

    Its last weights are kept, since candidates that all end where they began differ in nothing.
    """
    return stage.model_copy(
        update={
            "steps": search.steps,
            "warmup": round(stage.warmup * search.steps / stage.steps),
            "validate_every": search.steps,
            "validation_pairs": search.validation_pairs,
            "keep": "last",
        }
    )


def _tried(errors: Callable[[float], Errors], search: LambdaSearch) -> dict[float, Errors]:
    """The errors of every λ of the grid, and of those that it goes on with."""
    tried = {weight: errors(weight) for weight in sorted(search.candidates)}
    for _ in range(search.extend):
        further = beyond_the_edge(list(tried), _best(tried, search))
        if further is None:
            break
        tried[further] = errors(further)
    return tried


def _best(tried: Mapping[float, Errors], search: LambdaSearch) -> float:
    means = {weight: found[search.criterion] for weight, found in tried.items()}
    return best_lambda(means, search.tolerance)


def best_lambda(means: Mapping[float, float], tolerance: float) -> float:
    """The largest λ whose mean error exceeds the lowest by no more than a share ``tolerance``.

    Two trainings of one λ differ by chance, and among those that this hides the one with the
    strongest prior says most: the idea of the one-standard-error rule of Breiman et al. (1984),
    Classification and Regression Trees, section 3.4.3.
    """
    bound = (1 + tolerance) * min(means.values())
    return max(weight for weight, mean in means.items() if mean <= bound)


def beyond_the_edge(tried: Sequence[float], best: float) -> float | None:
    """The next λ to try where the best of the tried ones is the largest or smallest.

    It is as many times larger or smaller as the last two are apart; None where the best lies inside
    the grid, or there is only one.
    """
    weights = sorted(tried)
    if len(weights) < 2:
        return None
    inner = {weights[0]: weights[1], weights[-1]: weights[-2]}.get(best)
    # Rounded, so that names and numbers of 1e-4 · 10 are those of 1e-3.
    return None if inner is None else float(f"{best * best / inner:.6g}")

"""Commands from raw meshes to pairs."""

from __future__ import annotations

import json
from pathlib import Path

import click

from dine import config
from dine.cli.console import tell
from dine.cli.options import (
    IN,
    OUT_FOLDER,
    json_option,
    out_option,
    pairs_option,
    seed_option,
    settings_option,
)
from dine.files import write_json


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@json_option
def inspect(folder: Path, as_json: bool):
    """List what a folder of meshes holds, per condition and level, and what is left out and why.

    A manifest (CSV) of pairs will do as well.

    Example: dine inspect ~/scans/liver
    """
    from dine.data.layout import scan

    inventory = scan(folder)
    table = inventory.table() if inventory.has_pairs else None
    if table is None:
        lines = [f"{len(inventory.bases)} undeformed objects; targets would be made from them."]
    else:
        lines = table.to_string(index=False).splitlines()
    if inventory.split_file:
        lines.append(f"Split file: {inventory.split_file}")
    lines += [f"left out: {path}: {reason}" for path, reason in inventory.left_out]
    facts = {
        "pairs": [] if table is None else json.loads(table.to_json(orient="records")),
        "undeformed": len(inventory.bases),
        "split_file": inventory.split_file,
        "left_out": [{"file": path, "reason": reason} for path, reason in inventory.left_out],
    }
    tell(lines, facts, as_json)


@click.command()
@settings_option(config.Dataset)
@click.option("--first-object", type=click.IntRange(0), default=0, help="First synthetic number.")
@seed_option
@out_option("The dataset's results folder.", OUT_FOLDER)
def raw(settings: config.Dataset, first_object: int, seed: int, out: Path):
    """Make, find or download raw meshes.

    Example: dine raw --settings '{"source": {"kind": "path", "folder": "scans"}}' --out mine
    """
    from dine.data.obtain import obtain

    deformations = None
    if settings.recipe.kind == "elastic":
        from dine.simulation.targets import ElasticDeformations

        deformations = ElasticDeformations.of(settings.recipe, seed)
    obtain(settings, out, seed=seed, first_object=first_object, deformations=deformations)


@click.command()
@click.option("--raw", "raw_file", type=IN, required=True, help="raw.json of `dine raw`.")
@settings_option(config.Pairs)
@seed_option
@click.option("--test-only", is_flag=True, help="All objects for testing, whatever the split.")
@click.option("--unseen", type=IN, help="raw.json of further objects, for testing only.")
@out_option("Pairs to write (HDF5).")
def pairs(raw_file: Path, settings: config.Pairs, seed: int, test_only, unseen, out: Path):
    """Turn raw meshes into index-consistent source/target pairs.

    Example: dine pairs --raw mine/raw.json --out pairs.h5
    """
    from dine.data.prepare import prepare_pairs

    prepare_pairs(raw_file, settings, seed=seed, out=out, test_only=test_only, unseen=unseen)


levels_option = click.option(
    "--at",
    "levels",
    type=float,
    multiple=True,
    help="Deformation level to draw for; repeatable. All of them by default.",
)
most_option = click.option(
    "--most",
    type=click.IntRange(1),
    help="At most so many test pairs, spread over levels; of known objects, where there are any.",
)


@click.command()
@pairs_option
@click.option("--condition", type=click.Choice(["noise", "outliers"]), required=True)
@click.option("--level", type=float, required=True, help="Noise sigma, or outliers in percent.")
@levels_option
@most_option
@seed_option
@out_option("Variant to write (HDF5).")
def corrupt(pairs: Path, condition: str, level: float, levels, most, seed: int, out: Path):
    """Draw corrupted targets for the test split.

    Example: dine corrupt --pairs pairs.h5 --condition noise --level 0.03 --out noise.h5
    """
    from dine.data.corruption import make_variant
    from dine.data.pairs import evaluated_pairs, read_pairs, write_variant

    found = read_pairs(pairs)
    variant = make_variant(evaluated_pairs(found, levels, most), condition, level, seed)
    write_variant(out, variant, found.checksum)


@click.command()
@click.option(
    "--raw", "raw_files", type=IN, required=True, multiple=True, help="raw.json; repeatable."
)
@pairs_option
@levels_option
@most_option
@seed_option
@out_option("Targets to write (HDF5).")
def resample(raw_files, pairs: Path, levels, most, seed: int, out: Path):
    """Draw the points of all targets anew, as two scans of one object never share points.

    Example: dine resample --raw mine/raw.json --pairs pairs.h5 --out resampled.h5
    """
    from dine.data.prepare import resample_targets

    resample_targets(raw_files, pairs, seed=seed, out=out, levels=levels, most=most)


@click.command()
@pairs_option
@out_option("Result (JSON).")
@seed_option
def agreement(pairs: Path, seed: int, out: Path):
    """Measure how well the index convention holds across objects.

    Example: dine agreement --pairs pairs.h5 --out agreement.json
    """
    from dine.data.prepare import measure_agreement

    write_json(out, measure_agreement(pairs, seed=seed))

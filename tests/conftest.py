import importlib
import json
import os
from pathlib import Path

import pytest
from commands import RAW, STAGE1, STAGE2, dine

from dine import provenance

SHARED = Path(__file__).resolve().parents[2] / "shared"


# Longest first, so that no worker is left alone with one of them in the end.
LONG = (
    *("workflow/test_reruns.py", "workflow/test_workflow.py", "integration/test_stages.py"),
    *("integration/test_register.py", "integration/test_parallel.py", "unit/test_evidence.py"),
    *("hostile/test_fuzz.py", "project/", "workflow/"),
)


def pytest_collection_modifyitems(items):
    """The order for ``make test``, where each of two workers gets whole files."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    here = Path(__file__).parent

    def place(item):
        name = item.path.relative_to(here).as_posix()
        return next((i for i, start in enumerate(LONG) if name.startswith(start)), len(LONG))

    items.sort(key=place)


@pytest.fixture
def shared() -> Path:
    """Reference material beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("../shared (reference meshes and published checkpoint) is not present")
    return SHARED


@pytest.fixture(scope="session")
def chain(tmp_path_factory):
    """One small run of every step."""
    root = tmp_path_factory.mktemp("run")
    dine("raw", "--settings", RAW, "--seed", 1, "--out", root)
    pairs = root / "pairs.h5"
    split = {"train": 0.5, "val": 0.25, "test": 0.25}
    dine(
        *("pairs", "--raw", root / "raw.json", "--out", pairs, "--seed", 1),
        *("--settings", json.dumps({"points": 64, "convention": "disc", "split": split})),
    )
    variant = root / "outliers_25.h5"
    dine(
        *("corrupt", "--pairs", pairs, "--condition", "outliers", "--level", 25),
        *("--out", variant),
    )
    dine("stage1", "--pairs", pairs, "--settings", STAGE1, "--out", root / "stage1")
    model = root / "stage1" / "model.safetensors"
    dine("fields", "--model", model, "--pairs", pairs, "--out", root / "dvf.h5")
    for name, arguments in (("pca", {"components": 2}), ("flow", {"steps": 5, "hidden": 8})):
        dine(
            *("fit-prior", "--fields", root / "dvf.h5", "--out", root / f"{name}.safetensors"),
            *("--settings", json.dumps({"kind": name, "arguments": arguments})),
        )
    dine(
        *("search-lambda", "--pairs", pairs, "--model", model, "--out", root / "lambda.json"),
        *("--prior", "pca", root / "pca.safetensors", "--stage2", STAGE2),
        *(
            "--settings",
            '{"candidates": [0.001, 0.1], "extend": 0, "steps": 2, "validation_pairs": 1}',
        ),
    )
    return root


@pytest.fixture
def fresh(monkeypatch):
    """Forget before and after what was found out about code; call it to forget again."""

    def forget():
        provenance.forget()
        importlib.invalidate_caches()

    forget()
    yield forget
    monkeypatch.undo()
    forget()

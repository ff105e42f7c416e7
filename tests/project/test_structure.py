"""The rules of CONTRIBUTING.md about what stands where."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "dine"
RULES = sorted((ROOT / "workflow" / "rules").glob("*.smk"))

# From the ground up: a module imports from its own floor and those before it.
FLOORS = [
    ("errors", "extras", "files", "optimiser", "progress", "registry", "state", "threads"),
    ("config",),
    ("results", "provenance"),
    ("plan",),
    ("geometry",),
    ("io",),
    ("data",),
    ("models",),
    ("simulation", "priors"),
    ("refinement",),
    ("training",),
    ("evaluation",),
    ("viewer",),
    ("classical", "registration"),
    ("trials",),
    ("reporting",),
    ("cli",),
]


def floor_of(module):
    """The floor of ``dine.x.y``."""
    part = module.split(".")[1]
    return next(floor for floor, names in enumerate(FLOORS) if part in names)


def imported(path):
    """Modules of ``dine`` that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            whole = node.module == "dine"
            names = [f"dine.{alias.name}" for alias in node.names] if whole else [node.module]
        else:
            continue
        yield from (name for name in names if name.startswith("dine.") and "__" not in name)


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(("dine", *path.relative_to(PACKAGE).with_suffix("").parts))
        if name not in ("dine.__init__", "dine.__main__"):
            yield pytest.param(name.removesuffix(".__init__"), path, id=name)


@pytest.mark.parametrize(("name", "path"), modules())
def test_nothing_imports_upwards(name, path):
    own = floor_of(name)
    assert not {other for other in imported(path) if floor_of(other) > own}


LONGEST, MOST_PARAMETERS = 60, 7
EXCEPTIONS = {
    "dine.registration.register.register": "public, all but two of its arguments by keyword",
}


def functions(node, name):
    """All functions below a syntax tree's node, by their full names."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if not isinstance(inner, ast.ClassDef):
                yield f"{name}.{inner.name}", inner
            yield from functions(inner, f"{name}.{inner.name}")
        else:
            yield from functions(inner, name)


def parameters(function):
    """How many parameters a function takes, apart from ``self`` and its like."""
    given = function.args
    names = [p.arg for p in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [p.arg for p in (given.vararg, given.kwarg) if p is not None]
    return len([name for name in names if name not in ("self", "cls", "ctx")])


def is_kernel(function):
    return any("jit" in ast.unparse(decorator) for decorator in function.decorator_list)


@pytest.mark.parametrize(("name", "path"), modules())
def test_functions_are_short_and_take_few_parameters(name, path):
    found = dict(functions(ast.parse(path.read_text()), name))
    assert not {
        (other, function.end_lineno - function.lineno + 1, parameters(function))
        for other, function in found.items()
        if other not in EXCEPTIONS
        and not is_kernel(function)
        and (
            function.end_lineno - function.lineno >= LONGEST
            or parameters(function) > MOST_PARAMETERS
        )
    }


def test_exceptions_are_still_needed():
    """An exception that no function needs any more goes."""
    needed = set()
    for name, path in (parameter.values for parameter in modules()):
        for other, function in functions(ast.parse(path.read_text()), name):
            if parameters(function) > MOST_PARAMETERS and not is_kernel(function):
                needed.add(other)
    assert needed == set(EXCEPTIONS)


def test_contributing_lists_the_packages_from_the_ground_up():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    listed = re.findall(r"^\| `dine\.(\w+)` \|", text, re.MULTILINE)
    packages = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert set(listed) == packages
    assert [floor_of(f"dine.{name}") for name in listed] == sorted(
        floor_of(f"dine.{name}") for name in listed
    )


@pytest.mark.parametrize("path", RULES, ids=lambda path: path.name)
def test_rules_compute_nothing_and_know_no_names_of_results(path):
    text = path.read_text()
    if path.name != "common.smk":
        assert not re.search(r"^\s*def ", text, re.MULTILINE)
    assert not re.findall(r"\w+\.(?:h5|csv|json|safetensors|html|pdf|tsv|log)[\"']", text)
    assert len(text.splitlines()) <= (200 if path.name == "common.smk" else 400)


def test_only_results_knows_where_a_run_keeps_its_files():
    named = re.compile(r'"(?:pairs\.h5|raw\.json|run\.json|history\.csv|metrics\.csv|dvf\.h5)"')
    for path in sorted(PACKAGE.rglob("*.py")):
        if path != PACKAGE / "results.py":
            assert not named.search(path.read_text()), path


def test_contributing_names_what_is_there():
    """Each path of its tables exists, and holds the names that follow it."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (table,) = re.findall(r"\| what \| where \|\n((?:\|.+\n)+)", text)
    content, named = "", 0
    for token in re.findall(r"`([^` ]+)`", re.sub(r"^\|[^|]+\|", "|", table, flags=re.MULTILINE)):
        if "/" in token:
            content = (ROOT / token).read_text()
            continue
        named += 1
        for name in token.split("."):
            assert re.search(
                rf"^\s*(?:def|class|rule) {name}\b|^{name}\b", content, re.MULTILINE
            ), token
    assert named > 10

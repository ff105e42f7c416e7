"""Who made a result: code, versions, inputs. Cheap to import, since every DAG asks for it.

The code behind a step is found by reading, without running any of it: the step's command below
``dine.cli``, the modules that it imports, those that they import, and so on; and the modules of the
classes that the configuration names, a user's own among them.
"""

from __future__ import annotations

import ast
import contextlib
import csv
import functools
import hashlib
import os
import platform
import re
import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from dine import __version__
from dine.errors import ConfigError

PACKAGE = Path(__file__).parent

NEUTRAL = frozenset(
    f"dine{name}"
    for name in (
        "",
        ".cli",
        ".config",
        ".errors",
        ".extras",
        ".progress",
        ".provenance",
        ".registry",
        ".results",
    )
)
"""Modules that everything uses and whose code is in no result: settings reach a step as parameters,
with all their defaults."""

_DATA = re.compile(r"""["']([\w-]+\.(?:html|csv|js|txt))["']""")
_REGISTERED = re.compile(r"""\.register\("(\w+)"\)""")
_STDLIB = sysconfig.get_paths()["stdlib"]
_LIBRARIES = frozenset({"site-packages", "dist-packages"})


_read: list[functools._lru_cache_wrapper] = []


def _read_once(function: Callable) -> functools._lru_cache_wrapper:
    """Keep what is found out about code, which does not change while a process runs."""
    _read.append(functools.cache(function))
    return _read[-1]


def forget() -> None:
    """Read code anew, where it did change."""
    for found in _read:
        found.cache_clear()


@_read_once
def code_digest(step: str, *classes: str) -> str:
    """Digest of the code behind a step: changes when that does, not with comments or docstrings.

    Args:
        step: a command of ``dine``, such as ``fit-prior``.
        classes: what the configuration picks for it: built-in names and import paths
            ``package.module:Class``.

    Raises:
        ConfigError: no such class, its module is not on the Python path, or is not Python.
    """
    digest = hashlib.sha256(_command(step)[0].encode())
    for name, file in sorted(code_files(step, *classes).items()):
        digest.update(name.encode())
        digest.update(_meaning(file))
    return digest.hexdigest()[:16]


@_read_once
def _meaning(file: Path) -> bytes:
    """Digest of what a file says: of Python its syntax tree, of anything else its bytes."""
    content = _tree(_parsed(file)).encode() if file.suffix == ".py" else file.read_bytes()
    return hashlib.sha256(content).digest()


def _tree(node: Any) -> str:
    """A syntax tree as text; without empty fields, which come and go with Python's versions."""
    if isinstance(node, list):
        return f"[{','.join(map(_tree, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [(name, value) for name, value in ast.iter_fields(node) if value not in (None, [])]
    return f"{type(node).__name__}({','.join(f'{name}={_tree(x)}' for name, x in fields)})"


@_read_once
def code_files(step: str, *classes: str) -> dict[str, Path]:
    """The source files behind a step, and what they read from beside themselves, by name.

    Arguments and errors as for :func:`code_digest`.
    """
    found: dict[str, Path] = {}
    for module in _command(step)[1]:
        _follow(module, ("dine",), found)
    for name in classes:
        for module in _modules_of(name):
            _follow(module, ("dine", module.partition(".")[0]), found)
    return found


@_read_once
def _command(step: str) -> tuple[str, tuple[str, ...]]:
    """What a command does, as text without its help, and the modules that it imports."""
    name = step.replace("-", "_")
    for file in sorted((PACKAGE / "cli").glob("*.py")):
        for node in _parsed(file).body:
            if isinstance(node, ast.FunctionDef) and node.name == name:
                return _tree(node.body), tuple(_imports(node.body, f"dine.cli.{file.stem}", False))
    raise KeyError(step)


def _modules_of(name: str) -> list[str]:
    """The modules behind a class's name: of an import path, or where a built-in is registered."""
    if ":" not in name:
        if name in _registered():
            return _registered()[name]
        raise ConfigError(
            f"Unknown class {name!r}; expected one of {', '.join(sorted(_registered()))} or an "
            "import path 'package.module:Class'."
        )
    module = name.partition(":")[0]
    if _source(module) is None:
        raise ConfigError(
            f"The class {name!r} cannot be found: there is no Python file of the module "
            f"{module!r} on the Python path (PYTHONPATH, or install the package)."
        )
    return [module]


@_read_once
def _registered() -> dict[str, list[str]]:
    """Modules of ``dine`` by the names under which they register classes."""
    found: dict[str, list[str]] = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(("dine", *file.relative_to(PACKAGE).with_suffix("").parts))
        for name in _REGISTERED.findall(file.read_text(encoding="utf-8")):
            found.setdefault(name, []).append(module)
    return found


def _follow(module: str, roots: tuple[str, ...], found: dict[str, Path]) -> None:
    """Add a module and, unless it is installed and foreign, all that it imports to ``found``."""
    file = _source(module)
    neutral = module in NEUTRAL or module.startswith("dine.cli.")
    if module in found or neutral or file is None or not _own(module, file, roots):
        return
    found[module] = file
    if module.partition(".")[0] == "dine":
        _add_data(file, found)
    for other in _imported(module, file):
        _follow(other, roots, found)


def _own(module: str, file: Path, roots: tuple[str, ...]) -> bool:
    """Whether code belongs to ``dine`` or to the user, not to Python or a library."""
    if module.partition(".")[0] in roots:
        return True
    return not str(file).startswith(_STDLIB) and not _LIBRARIES.intersection(file.parts)


def _add_data(file: Path, found: dict[str, Path]) -> None:
    """Add the files beside a module, or above it in the package, that it names; templates too."""
    for name in _DATA.findall(file.read_text(encoding="utf-8")):
        for folder in file.relative_to(PACKAGE).parents[:-1]:
            path = PACKAGE / folder / name
            key = path.relative_to(PACKAGE).as_posix()
            if path.is_file() and key not in found:
                found[key] = path
                _add_data(path, found)


@_read_once
def _parsed(file: Path) -> ast.Module:
    """The syntax tree of a module, without docstrings and other statements that are mere text."""
    try:
        tree = ast.parse(file.read_bytes(), str(file))
    except (OSError, SyntaxError, ValueError) as error:
        raise ConfigError(f"{file} cannot be read as Python: {error}.") from None
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [statement for statement in node.body if not _is_text(statement)]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    """Whether a statement is a string and nothing else, as a docstring is."""
    if not isinstance(statement, ast.Expr) or not isinstance(statement.value, ast.Constant):
        return False
    return isinstance(statement.value.value, str)


@_read_once
def _imported(module: str, file: Path) -> tuple[str, ...]:
    return tuple(dict.fromkeys(_imports(_parsed(file).body, module, file.name == "__init__.py")))


def _imports(body: list[ast.stmt], module: str, is_package: bool) -> Iterator[str]:
    """The modules that some statements import, those inside functions among them."""
    package = module if is_package else module.rpartition(".")[0]
    waiting: list[ast.AST] = list(body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _base(node, package)
            for alias in node.names:
                yield _defining(base, alias.name)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
        elif isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):
            waiting += ast.iter_child_nodes(node)


def _base(node: ast.ImportFrom, package: str) -> str:
    """What stands between ``from`` and ``import``, as an absolute name."""
    if not node.level:
        return node.module or ""
    above = package.split(".")[: len(package.split(".")) - node.level + 1]
    return ".".join([*above, *([node.module] if node.module else [])])


def _defining(module: str, name: str) -> str:
    """Where ``from module import name`` comes from: a package may only pass it on."""
    if _source(f"{module}.{name}") is not None:
        return f"{module}.{name}"
    file = _source(module)
    if file is not None and file.name == "__init__.py":
        # Also under TYPE_CHECKING, where stands what is passed on when it is asked for.
        for node in ast.walk(_parsed(file)):
            if isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    if (alias.asname or alias.name) == name:
                        return _defining(_base(node, module), alias.name)
    return module


@_read_once
def _source(module: str) -> Path | None:
    """The Python file of a module, found without importing anything; None if it has none."""
    top, *below = module.split(".")
    if top in sys.stdlib_module_names:
        return None
    if top == "dine":
        path = PACKAGE.joinpath(*below)
        candidates = (path.with_name(f"{path.name}.py"), path / "__init__.py")
        return next((file for file in candidates if file.is_file()), None)
    spec, path = None, None
    for count in range(len(below) + 1):
        name = ".".join([top, *below[:count]])
        finders = (f for f in sys.meta_path if hasattr(f, "find_spec"))
        spec = next((s for f in finders if (s := f.find_spec(name, path))), None)
        if spec is None or (count < len(below) and spec.submodule_search_locations is None):
            return None
        path = spec.submodule_search_locations
    origin = spec.origin or ""
    return Path(origin) if origin.endswith(".py") else None


def versions() -> dict[str, str]:
    """Versions of this package, Python and the libraries that results depend on."""
    names = ("numpy", "scipy", "torch", "scikit-learn", "h5py", "trimesh", "pandas", "zuko")
    found = {"dine": __version__, "python": platform.python_version()}
    for name in (*names, "numba"):
        with contextlib.suppress(metadata.PackageNotFoundError):  # only an extra brings it
            found[name] = metadata.version(name)
    return found


def folder_signature(folder: str | os.PathLike) -> str:
    """Digest of the names, sizes and times of all files below a folder; contents are not read.

    Of a manifest (CSV) it is that of the file and of those that it lists.
    """
    digest = hashlib.sha256()
    for path in _listed(folder) if os.path.isfile(folder) else _below(folder):
        try:
            stat = os.stat(path)
        except OSError:
            continue
        digest.update(f"{path}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _below(folder: str | os.PathLike) -> Iterator[str]:
    for root, folders, files in os.walk(folder):
        folders.sort()
        yield from (os.path.join(root, name) for name in sorted(files))


def _listed(manifest: str | os.PathLike) -> Iterator[str]:
    yield str(manifest)
    # Whoever reads the pairs says what is wrong with it.
    with open(manifest, newline="", errors="replace") as file:
        for row in csv.DictReader(file):
            for column in ("source", "target"):
                yield os.path.join(os.path.dirname(manifest), str(row.get(column)))


COMMAND = "DINE_COMMAND"
"""Environment variable in which the workflow passes on the command that a user gave."""

CPU_SETTINGS = (
    *("ATEN_CPU_CAPABILITY", "DNNL_MAX_CPU_ISA", "GLIBC_TUNABLES", "MKL_CBWR"),
    *("MKL_ENABLE_INSTRUCTIONS", "NPY_DISABLE_CPU_FEATURES", "NUMBA_CPU_FEATURES"),
    *("NUMBA_CPU_NAME", "OMP_NUM_THREADS", "ONEDNN_MAX_CPU_ISA", "OPENBLAS_CORETYPE"),
)
"""Environment variables by which numerical libraries compute as on another CPU."""


def run_record(settings: dict[str, Any], seed: int, **facts: Any) -> dict[str, Any]:
    """What every run writes beside its result."""
    return {"settings": settings, "seed": seed, "versions": versions(), "made": made(), **facts}


def made() -> dict[str, str]:
    """On which CPU, of which commit, when and by which command something is made.

    Results of a training depend on the CPU by rounding, which chaos enlarges.
    """
    own = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    settings = {name: os.environ[name] for name in CPU_SETTINGS if name in os.environ}
    found = {
        "CPU": f"{_cpu_name()}, {os.cpu_count()} threads",
        "commit": _commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": os.environ.get(COMMAND, own),
    }
    if settings:
        found["CPU settings"] = " ".join(f"{name}={value}" for name, value in settings.items())
    return found


def _cpu_name() -> str:
    """The processor as the system names it."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # no Linux
        text = ""
    name = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return name[1].strip() if name else platform.processor() or platform.machine() or "unknown"


@functools.cache
def _commit() -> str:
    """The commit of the checkout that this package lies in, if it does."""
    if not (PACKAGE.parent / ".git").exists():
        return f"none (installed package, version {__version__})"

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(PACKAGE.parent), *arguments]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=30
        ).stdout.strip()

    try:
        head = git("rev-parse", "HEAD")
        return f"{head} with changes" if git("status", "--porcelain", "-uno") else head
    except (OSError, subprocess.SubprocessError):
        return "unknown (git cannot be asked)"

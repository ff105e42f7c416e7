"""What the pages say can be typed: Python blocks run, command lines parse, quoted files are equal.

An HTML comment before a block says what it is: ``<!-- not run: reason -->`` for Python that is not
run here, ``<!-- file: path -->`` for a block that quotes a file.
"""

import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
import yaml
from commands import leaves
from snakemake.cli import parse_args

from dine import __version__, cli
from dine.config import Dataset, Pairs, Recipe, Split
from dine.data.obtain import obtain
from dine.data.prepare import prepare_pairs

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
SHELL = {"", "sh", "bash", "console"}
PROGRAMS = {"dine", "snakemake", "make"}


@dataclass
class Block:
    """A fenced code block and what the comment before it says."""

    page: Path
    line: int
    language: str
    text: str
    comment: str

    def __str__(self):
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page):
    """The fenced blocks of a page; those inside lists too."""
    found, comment, fence = [], "", None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        opening = re.match(r"(\s*)(```+)(\w*)", line)
        if fence is None and opening:
            fence = opening[2]
            indent = len(opening[1])
            found.append(Block(page, number, opening[3], "", comment))
        elif fence is not None and line.strip() == fence:
            fence, comment = None, ""
        elif fence is not None:
            found[-1].text += line[indent:] + "\n"
        elif line.strip():
            remark = re.fullmatch(r"\s*<!-- (.*) -->", line)
            comment = remark[1] if remark else ""
    assert fence is None, f"{page}: a block is not closed"
    return found


BLOCKS = [block for page in PAGES for block in blocks(page)]
QUOTED = [block for block in BLOCKS if block.comment.startswith("file: ")]
PYTHON = [block for block in BLOCKS if block.language == "python" and block not in QUOTED]


def commands(block):
    """Simple commands of a shell block as lists of words, without variables set before them."""
    for line in block.text.replace("\\\n", " ").splitlines():
        line = line.removeprefix("$ ")
        # Blocks without a language may hold anything.
        if not block.language and line.partition(" ")[0] not in PROGRAMS:
            continue
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words = []
        for word in [*lexer, ";"]:
            if set(word) <= set("();<>|&"):
                if words:
                    yield words
                words = []
            elif words or not re.match(r"\w+=", word):
                words.append(word)


def command_lines(program):
    """Every use of a program in the shell blocks of all pages."""
    return [
        pytest.param(words[1:], id=f"{block} {' '.join(words)}")
        for block in BLOCKS
        if block.language in SHELL
        for words in commands(block)
        if words[0] == program
    ]


@pytest.fixture
def in_checkout(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize("words", command_lines("dine"))
def test_dine_command_lines_parse(words, in_checkout, monkeypatch):
    """Commands, options and their values are known; nothing is executed."""
    called = []
    monkeypatch.setattr(cli.cli, "callback", lambda **values: None)
    for _, command in leaves(cli.cli):
        monkeypatch.setattr(command, "callback", lambda **values: called.append(values))
    assert not cli.cli.main(words, prog_name="dine", standalone_mode=False)
    assert called or {"--help", "-h", "--version"} & set(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_named_in_the_text_exist(page):
    """``dine stage1 …`` in running text: the command at least is one of ours."""
    for named in re.findall(r"`dine ([a-z][\w-]*(?: [a-z][\w-]*)?)[^`]*`", page.read_text()):
        words = named.split()
        command = cli.cli.commands.get(words[0])
        assert command, f"{page.name}: dine {named}"
        if isinstance(command, click.Group) and len(words) > 1:
            assert words[1] in command.commands, f"{page.name}: dine {named}"


@pytest.fixture(scope="module")
def rules():
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--list-rules"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("words", command_lines("snakemake"))
def test_snakemake_command_lines_parse(words, rules, in_checkout):
    """Options are Snakemake's own; targets and forced rules exist, and so do configurations."""
    _, args = parse_args(words)
    wanted = {*args.targets, *(args.forcerun or [])}
    # Files below the results folder are targets, too.
    assert {target for target in wanted if "/" not in target} <= rules
    for path in args.configfile or []:
        assert path.is_file() or path.name == "my.yaml"  # the reader's own


@pytest.mark.parametrize("words", command_lines("make"))
def test_make_targets_exist(words):
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {word for word in words if "=" not in word} <= set(targets)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with the files that the pages speak of: small pairs, and the meshes they are of."""
    root = tmp_path_factory.mktemp("docs")
    recipe = Recipe(shape="tissue", objects=3, levels=[0.3])
    settings = Pairs(points=64, convention="disc", split=Split(train=0.4, val=0.3, test=0.3))
    obtain(Dataset(recipe=recipe, pairs=settings), root, seed=0)
    prepare_pairs(root / "raw.json", settings, seed=0, out=root / "pairs.h5")
    (root / "raw").rename(root / "data")
    return root


@pytest.mark.parametrize("block", PYTHON, ids=str)
def test_python_blocks_run(block, files, monkeypatch):
    if block.comment.startswith("not run: "):
        compile(block.text, str(block), "exec")
        pytest.skip(block.comment)
    monkeypatch.chdir(files)
    exec(compile(block.text, str(block), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("block", QUOTED, ids=str)
def test_quoted_files_are_equal(block):
    assert block.text == (ROOT / block.comment.removeprefix("file: ")).read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    """Relative links, also those that the documentation site does not see."""
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not re.match(r"\w+:|#", link):
            assert (page.parent / link.partition("#")[0]).exists(), link


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text().replace("!!python/name:", "")

    def entries(nav):
        for entry in nav:
            if isinstance(entry, dict):
                (entry,) = entry.values()
            yield from entries(entry) if isinstance(entry, list) else [entry]

    listed = sorted(entries(yaml.safe_load(text)["nav"]))
    assert listed == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


def test_citation_and_changelog_follow_the_package():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    cited = {work.get("doi", "").lower() for work in citation["references"]}
    datasets = yaml.safe_load((ROOT / "config.yaml").read_text())["datasets"].values()
    assert {dataset["source"]["doi"].removeprefix("doi:").lower() for dataset in datasets} <= cited
    versions = re.findall(r"^## \[?([\w.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == "Unreleased"
    assert __version__ in versions

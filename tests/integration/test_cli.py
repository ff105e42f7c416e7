"""What the help of every command says."""

import shlex
import shutil
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from dine import cli
from dine.io.readers import read_surface

CONFIG = Path(__file__).resolve().parents[2] / "config.yaml"


def leaves(group, path=()):
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from leaves(command, (*path, name))
        else:
            yield (*path, name), command


def examples(command):
    """The command lines that a command's help shows."""
    text = f"{command.help or ''}\n\n{command.epilog or ''}"
    lines, current = [], None
    for line in text.splitlines():
        words = line.strip().removeprefix("Example: ")
        if words.startswith("dine "):
            current = [words]
            lines.append(current)
        elif current and words and words != "\\b":
            current.append(words)
        else:
            current = None
    return [shlex.split(" ".join(line))[1:] for line in lines]


@pytest.mark.parametrize(
    ("path", "command"), leaves(cli.cli), ids=lambda x: " ".join(x) if isinstance(x, tuple) else ""
)
def test_every_command_shows_an_example_that_parses(path, command, tmp_path, monkeypatch):
    shown = examples(command)
    assert shown, f"dine {' '.join(path)} has no example"
    monkeypatch.chdir(tmp_path)
    for name in ("config.yaml", "my.yaml"):  # read as soon as the line is parsed
        shutil.copy(CONFIG, tmp_path / name)
    called = []
    monkeypatch.setattr(cli.cli, "callback", lambda **values: None)
    monkeypatch.setattr(command, "callback", lambda **values: called.append(values))
    for words in shown:
        assert tuple(words[: len(path)]) == path
        cli.cli.main(words, prog_name="dine", standalone_mode=False)
    assert len(called) == len(shown)


def test_scans_to_try_things_with(tmp_path):
    done = CliRunner().invoke(cli.cli, ["scans", str(tmp_path / "trial")])
    assert done.exit_code == 0
    before, after = (read_surface(tmp_path / "trial" / f"{x}.ply") for x in ("before", "after"))
    assert len(before.faces) > len(after.faces) > 1000
    # They are not written over.
    again = CliRunner().invoke(cli.cli, ["scans", str(tmp_path / "trial")])
    assert "is there already" in str(again.exception)

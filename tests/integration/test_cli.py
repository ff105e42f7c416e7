"""What the help of every command says, and in which form they speak."""

import importlib
import json
import re
import shlex
import shutil
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from commands import leaves

from dine import cli
from dine.io.readers import read_surface

CONFIG = Path(__file__).resolve().parents[2] / "config.yaml"


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


@pytest.mark.parametrize(("module", "names"), cli.GROUPS.values())
def test_every_command_of_a_module_is_listed(module, names):
    commands = vars(importlib.import_module(f"dine.cli.{module}")).values()
    groups = [x for x in commands if isinstance(x, click.Group)]
    below = [x for group in groups for x in group.commands.values()]
    found = [x.name for x in commands if isinstance(x, click.Command) and x not in below]
    assert found == names.split()


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


def test_commands_are_listed_in_groups():
    """Every one once, those on one's own scans first."""
    shown = CliRunner().invoke(cli.cli, ["--help"]).output
    listed = re.findall(r"^  ([a-z][\w-]+)  ", shown, re.MULTILINE)
    assert listed[0] == "register"
    assert listed == list(cli.cli.commands)
    assert re.findall(r"^(\w.+):$", shown, re.MULTILINE) == ["Options", *cli.GROUPS]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["inspect", "none"], 1, "Error: none is not a folder; expected"),
        (["register", "a.ply"], 2, "Error: Missing argument 'TARGET'. See `dine register --help`."),
        (["inspec"], 2, "Error: No such command 'inspec'. Did you mean 'inspect'? See `dine"),
        (["--lof"], 2, "Error: No such option '--lof'"),
        (
            ["register", "a", "b", "-o", "c.ply", "--map", "-1"],
            2,
            "Error: Invalid value for '--map'",
        ),
        (["-q", "config", "check", "none.yaml"], 1, "Error: none.yaml"),
    ],
)
def test_all_errors_are_one_line_of_one_form(words, code, said, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["dine", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == code
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith(said)
    assert len(error.splitlines()) == 1


def test_options_of_dine_itself_are_said_to_stand_before_the_command(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["dine", "register", "--log", "a.log", "a.ply", "b.ply"])
    with pytest.raises(SystemExit):
        cli.main()
    said = capsys.readouterr().err
    assert "--log stands before the command: dine --log … register. See" in said


def test_details_of_errors_for_who_asks(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.argv", ["dine", "inspect", str(tmp_path / "none"), "-v"])
    with pytest.raises(SystemExit):
        cli.main()
    lines = capsys.readouterr().err.splitlines()
    assert "Traceback (most recent call last):" in lines
    assert lines[-1].startswith("Error: ")


def test_results_go_to_the_log_and_not_out_in_quiet(tmp_path):
    config = str(CONFIG)
    inspected = ["inspect", str(CONFIG.parent / "dine" / "scans")]
    done = CliRunner().invoke(cli.cli, ["--log", str(tmp_path / "log"), *inspected])
    assert "2 undeformed objects" in done.stdout
    assert done.stderr == ""
    assert "2 undeformed objects" in (tmp_path / "log").read_text()
    assert CliRunner().invoke(cli.cli, [*inspected, "-q"]).output == ""
    # The next one in the same process is as loud as ever.
    told = json.loads(CliRunner().invoke(cli.cli, [*inspected, "--json"]).stdout)
    assert (told["pairs"], told["undeformed"], told["left_out"]) == ([], 2, [])
    assert CliRunner().invoke(cli.cli, ["config", "check", config]).stdout

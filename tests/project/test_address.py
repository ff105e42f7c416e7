"""What a wheel says of where the project lives, once that is known."""

import re
import runpy
from pathlib import Path

import pytest
import setuptools

ROOT = Path(__file__).parents[2]


@pytest.fixture
def stated(monkeypatch):
    """What setup.py says, given an address."""

    def state(address):
        said = {}
        monkeypatch.setattr(setuptools, "setup", said.update)
        monkeypatch.setenv("DINE_ADDRESS", address)
        runpy.run_path(str(ROOT / "setup.py"))
        return said

    return state


def test_links_of_the_readme_are_absolute_at_an_address(stated):
    said = stated("https://example.org/dine/")
    links = re.findall(r"\]\(([^)\s]+)\)", said["long_description"])
    assert links
    assert all(re.match(r"https?://|mailto:|#", link) for link in links)
    there = [x.removeprefix("https://example.org/dine/") for x in links if "example.org" in x]
    assert any(x.startswith("raw/main/docs/images/") for x in there)
    files = [re.sub(r"^(raw|blob)/main/|#.*", "", x) for x in there]
    files += [u.partition("/main/")[2] for u in said["project_urls"].values() if "/main/" in u]
    assert all((ROOT / file).exists() for file in files)
    assert said["project_urls"]["Source"] == "https://example.org/dine"


def test_without_an_address_nothing_is_claimed(stated):
    said = stated("")
    assert said["project_urls"] == {}
    assert said["long_description"] == (ROOT / "README.md").read_text(encoding="utf-8")

"""Link what a wheel needs from this Python's environment into another, as it was installed here.

python .ci/link_needed.py WHEEL SITE_PACKAGES

That is what the wheel itself asks for, and what that asks for in turn, and nothing else.
"""

import sys
import zipfile
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement


def needed(lines: list[str]) -> dict[str, metadata.Distribution]:
    """Distributions by name that requirements, one a line, come to."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [(line, frozenset({""})) for line in lines]
    seen = set()
    while waiting:
        line, extras = waiting.pop()
        requirement = Requirement(line)
        marker = requirement.marker
        if marker and not any(marker.evaluate({"extra": extra}) for extra in extras):
            continue
        asked = (requirement.name, frozenset(requirement.extras) | {""})
        if asked not in seen:
            seen.add(asked)
            found[requirement.name] = metadata.distribution(requirement.name)
            waiting += [(line, asked[1]) for line in found[requirement.name].requires or ()]
    return found


def link(distribution: metadata.Distribution, place: Path) -> None:
    """All its files that lie in this environment's own ``site-packages``; scripts do not."""
    for file in distribution.files or ():
        if ".." in file.parts or "__pycache__" in file.parts:
            continue
        there = place / file
        there.parent.mkdir(parents=True, exist_ok=True)
        if not there.exists():
            there.symlink_to(distribution.locate_file(file))


wheel, place = Path(sys.argv[1]), Path(sys.argv[2])
with zipfile.ZipFile(wheel) as archive:
    name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    facts = archive.read(name).decode().partition("\n\n")[0].splitlines()
asked = [line.partition(": ")[2] for line in facts if line.startswith("Requires-Dist: ")]
found = needed(asked)
for distribution in found.values():
    link(distribution, place)
print(f"{len(found)} packages linked")

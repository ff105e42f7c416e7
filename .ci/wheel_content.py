"""Compare a wheel with the sources it was built from: every file that it needs, and its licences.

python .ci/wheel_content.py WHEEL SOURCES
"""

import sys
import zipfile
from pathlib import Path

wheel, sources = Path(sys.argv[1]), Path(sys.argv[2])
with zipfile.ZipFile(wheel) as archive:
    inside = {name for name in archive.namelist() if not name.endswith("/")}
    metadata = next(name for name in inside if name.endswith(".dist-info/METADATA"))
    facts = archive.read(metadata).decode()
information = metadata.removesuffix("METADATA")
expected = {
    path.relative_to(sources).as_posix()
    for path in (sources / "dine").rglob("*")
    # How the shipped weights were trained stays in the repository.
    if path.is_file() and not (path.parent.name == "weights" and path.suffix in (".csv", ".png"))
}
licences = {
    f"{information}licenses/{line.partition(': ')[2]}"
    for line in facts.splitlines()
    if line.startswith("License-File: ")
}
missing = (expected | licences) - inside
surplus = {name for name in inside - expected if not name.startswith(information)}
if missing or surplus or len(licences) < 2:
    sys.exit(f"{wheel.name}: missing {sorted(missing)}, surplus {sorted(surplus)}, {licences=}")
print(f"{wheel.name}: {len(expected)} files, {len(licences)} licences")

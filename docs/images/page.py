"""Draw page.jpg, the page of `dine register --view`: python docs/images/page.py (needs Chromium)"""

import subprocess
import tempfile
from pathlib import Path

from PIL import Image

import dine

HERE = Path(__file__).parent
SCANS = Path(dine.__file__).parent / "scans"

with tempfile.TemporaryDirectory() as folder:
    dine.register(SCANS / "before.ply", SCANS / "after.ply").save(folder, view=True)
    picture = Path(folder) / "page.png"
    command = (
        *("chromium", "--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1200,820"),
        *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--virtual-time-budget=5000"),
        *(f"--screenshot={picture}", (Path(folder) / "moved.html").as_uri()),
    )
    subprocess.run(command, check=True, capture_output=True)
    Image.open(picture).convert("RGB").save(HERE / "page.jpg", quality=85)  # a quarter of the PNG

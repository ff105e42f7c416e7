"""What depends on where the project lives, not known yet: DINE_ADDRESS=https://… pip wheel .

With that address the package states it, and links of the README lead there, since package indexes
follow no relative ones.
"""

import os
import re
from pathlib import Path

from setuptools import setup

ADDRESS = os.environ.get("DINE_ADDRESS", "").rstrip("/")
README = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
PAGES = {"Documentation": "docs/index.md", "Changelog": "CHANGELOG.md"}


def absolute(text: str, address: str) -> str:
    """Markdown whose relative links lead to files below an address, pictures to their content."""
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:)", rf"\g<1>{address}/raw/main/", text)
    return re.sub(r"(\]\()(?!\w+:|#)", rf"\g<1>{address}/blob/main/", text)


if ADDRESS:
    README = absolute(README, ADDRESS)
    PAGES = {name: f"{ADDRESS}/blob/main/{path}" for name, path in PAGES.items()}
    PAGES |= {"Source": ADDRESS, "Issues": f"{ADDRESS}/issues"}
else:
    PAGES = {}

setup(long_description=README, long_description_content_type="text/markdown", project_urls=PAGES)

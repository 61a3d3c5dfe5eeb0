"""Writes the first screen of report pages as pictures, by a headless browser.

python docs/gallery/make.py NAME=RUNFOLDER ...
"""

import io
import sys
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

from browser import Browser  # noqa: E402

with Browser() as browser:
    for name, folder in (word.split("=") for word in sys.argv[1:]):
        browser.open(Path(folder) / "report.html", 1280, height=1000)
        browser.picture(aside := HERE / "aside.png")
        picture = Image.open(io.BytesIO(aside.read_bytes())).convert("RGB").crop((0, 0, 1280, 1000))
        aside.unlink()
        picture.resize((960, 750), Image.Resampling.LANCZOS).quantize(128).save(HERE / f"{name}.png", optimize=True)

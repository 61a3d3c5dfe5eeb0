"""Writes the first screen of report pages as pictures, by a headless browser.

python docs/gallery/make.py NAME=RUNFOLDER ...
"""

import io
import json
import runpy
import sys
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

from browser import Browser  # noqa: E402

SITE = runpy.run_path(str(HERE.parent / "site.py"))
SOURCES = HERE / "sources.json"
sources = json.loads(SOURCES.read_text("utf-8")) if SOURCES.exists() else {}
with Browser() as browser:
    for name, folder in (word.split("=") for word in sys.argv[1:]):
        browser.open(Path(folder) / "report.html", 1280, height=1000)
        browser.picture(aside := HERE / "aside.png")
        picture = Image.open(io.BytesIO(aside.read_bytes())).convert("RGB").crop((0, 0, 1280, 1000))
        aside.unlink()
        picture.resize((960, 750), Image.Resampling.LANCZOS).quantize(128).save(HERE / f"{name}.png", optimize=True)
        sources[name] = SITE["picture_source"](name)
SOURCES.write_text(json.dumps(sources, indent=1, sort_keys=True) + "\n", encoding="utf-8")

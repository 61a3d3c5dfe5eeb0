"""Colours of the paper's configurations and models."""

from __future__ import annotations

from mmrjax.model.paper_tables import TRACKED, WHEELED
from sweeps.pages.figure_style import BLUE, GREEN, ORANGE, VERMILION

CONFIGURATION = {TRACKED: BLUE, WHEELED: VERMILION}
MODEL = {"nominal": BLUE, "sm1": ORANGE, "sm2": GREEN}

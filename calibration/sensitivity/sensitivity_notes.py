"""Remarks on a study, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

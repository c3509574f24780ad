"""Looking at a data set before hours of training: what is there, what is wrong with it, and what to do about it."""

from __future__ import annotations

from saunet.tools.doctor.findings import Finding, diagnose
from saunet.tools.doctor.manifests import manifest_of
from saunet.tools.doctor.sheet import draw_sheet
from saunet.tools.doctor.survey import Survey, survey

__all__ = ["Finding", "Survey", "diagnose", "draw_sheet", "manifest_of", "survey"]

"""Looking at a data set before hours of training: what is there, what is wrong with it, and what to do about it."""

from __future__ import annotations

from saunet.data.doctor.findings import Finding, diagnose
from saunet.data.doctor.manifests import manifest_of
from saunet.data.doctor.sheet import draw_sheet
from saunet.data.doctor.survey import Survey, survey

__all__ = ["Finding", "Survey", "diagnose", "draw_sheet", "manifest_of", "survey"]

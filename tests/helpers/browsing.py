"""A real browser for the tests of pages, and what axe-core says of a page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import pytest


@pytest.fixture
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    binary = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if binary is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as started:
        flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        minutes = 5 * 60_000.0  # on a busy machine everything takes long
        opened = started.chromium.launch(executable_path=binary, args=flags, timeout=minutes)
        context = opened.new_context(viewport={"width": 800, "height": 400})
        context.set_default_timeout(minutes)
        yield context
        opened.close()


def barriers(page: Any, schemes: Sequence[str] = ("light", "dark")) -> list[str]:
    """Return what keeps people out of a page, by axe-core: its serious and critical findings in each color scheme."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")
    found = []
    for scheme in schemes:
        page.emulate_media(color_scheme=scheme)
        found += [
            f"{scheme}: {each['id']}: {each['help']}: {each['nodes'][0]['html']}"
            for each in axe.Axe().run(page).response["violations"]
            if each["impact"] in ("serious", "critical")
        ]
    return found

"""Text from the templates that lie beside the code that fills them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment


def markdown_text(text: str) -> str:
    """Return text that cannot become markup in Markdown."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    loader = PackageLoader("saunet", "")
    made = Environment(
        loader=loader,
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["markdown"] = markdown_text
    return made


def rendered(template: str, **values: object) -> str:
    """Fill a template, named by its path within the package; values become no markup in HTML."""
    return _environment().get_template(template).render(values)

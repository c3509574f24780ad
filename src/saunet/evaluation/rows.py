"""Measurements of an evaluation: rows for each image, predictor and protocol, with means, intervals, differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

from saunet.metrics.functional import ERROR_HEADINGS, ERROR_NAMES
from saunet.tables import Column, Row, Table, columns

ERROR_COLUMNS = columns(*(f"{heading}|.3f" for heading in ERROR_HEADINGS))
COMPARED = dict(
    zip((*ERROR_NAMES, "warped", "explained"), (*ERROR_COLUMNS, *columns("warped ↓", "explained ↑")), strict=True)
)
"""Values of an image that are compared between two predictors, by name."""


@dataclass(frozen=True, slots=True)
class ImageRow:
    """The errors of one predictor on one image under one protocol."""

    predictor: str
    protocol: str
    name: str
    pixels: int
    """Number of pixels compared; 0 if the image has no ground truth, and the values are then NaN."""
    scale: float
    """Factor on the depth: from the alignment, or without one median(truth)/median(prediction)."""
    errors: tuple[float, ...]
    """In the order of `saunet.metrics.functional.ERROR_NAMES`, as everywhere below."""

    @property
    def compared(self) -> dict[str, float]:
        """Values that two predictors are compared by, from `COMPARED`; empty if nothing was measured."""
        return dict(zip(ERROR_NAMES, self.errors, strict=True)) if self.pixels else {}


@dataclass(frozen=True, slots=True)
class BucketRow:
    """Errors over all pixels of all images in one bucket (not a mean over images: some have few pixels there)."""

    predictor: str
    protocol: str
    group: str
    """The quantity that the buckets of a group divide, such as ``distance``."""
    bucket: str
    """The bucket, such as ``10-20 m``, ``bottom third`` or ``near an edge``."""
    pixels: int
    errors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ShapeRow:
    """How well one predictor preserves shapes in one image under one protocol; NaN if not measured."""

    predictor: str
    protocol: str
    name: str
    edge_accuracy: float
    """Pixels from predicted depth edges to true ones; see `saunet.metrics.shapes.boundary_scores`."""
    edge_completeness: float
    """Pixels from true depth edges to predicted ones."""
    precision: float
    """Fraction of predicted points near true ones; see `saunet.metrics.shapes.cloud_scores`."""
    recall: float
    """Fraction of true points near predicted ones."""
    f_score: float


@dataclass(frozen=True, slots=True)
class ViewRow:
    """How well a prediction explains the neighboring frames of one image, for data without depth.

    NaN, and visible nowhere, if the motion of the camera is unknown.
    """

    predictor: str
    protocol: str
    name: str
    condition: str
    """The condition or the recording that the image belongs to."""
    warped: float
    """Photometric error after warping the neighbors by depth and motion, SAU-Net eqs. (8) to (10)."""
    unwarped: float
    """The same without warping: the error of a network that has learned nothing."""
    explained: float
    """Fraction of pixels that warping brings closer, SAU-Net eq. (11)."""
    visible: float
    """Fraction of pixels visible in any neighbor."""

    @property
    def compared(self) -> dict[str, float]:
        """See `ImageRow`."""
        return {"warped": self.warped, "explained": self.explained} if self.visible else {}


@dataclass(frozen=True, slots=True)
class Summary:
    """Means of one predictor under one protocol over the images that have ground truth; NaN if none has."""

    predictor: str
    protocol: str
    errors: tuple[float, ...]
    scale: float
    scale_std: float
    images: int
    images_without_truth: int


@dataclass(frozen=True, slots=True)
class ViewSummary:
    """Means of one predictor without ground truth over the images of one condition, or of ``all``."""

    protocol: str
    predictor: str
    condition: str
    images: int
    warped: float
    unwarped: float
    explained: float
    visible: float


@dataclass(frozen=True, slots=True)
class ShapeSummary:
    """Means of `ShapeRow` of one predictor under one protocol, over the images that have each number."""

    protocol: str
    predictor: str
    edge_accuracy: float
    edge_completeness: float
    precision: float
    recall: float
    f_score: float
    edge_images: int
    """Number of images whose ground truth is dense and has edges."""
    cloud_images: int
    """Number of images whose point clouds were compared."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Bootstrap intervals of the means of one predictor under one protocol."""

    predictor: str
    protocol: str
    level: float
    by: str
    """What was resampled: whole ``drive``s, or single ``image``s if there are too few drives."""
    groups: int
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Difference:
    """The means of one error of two predictors on the same images."""

    name: str
    """One of `COMPARED`."""
    first: float
    second: float
    difference: float
    """``second - first``."""
    low: float
    high: float
    """Bootstrap interval of the difference; with zero outside it, the predictors differ."""
    better: float
    """Fraction of images on which the second is better; ties count half."""
    p_value: float | None
    """Probability of a difference at least this large if the labels were swapped at random drive by drive (two-sided);
    None with too few drives."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two predictors on the same images under one protocol."""

    protocol: str
    first: str
    second: str
    images: int
    level: float
    by: str
    groups: int
    differences: tuple[Difference, ...]

    def table(self, *notes: str) -> Table:
        """Return the differences as a table; bold if the interval excludes zero."""
        level = f"{self.level:.0%}".replace("%", " %")
        headings = (
            *columns("error"),
            *(Column(name, ".4f") for name in (self.first, self.second)),
            *columns("difference|+.4f", f"{level} low|+.4f", f"{level} high|+.4f"),
            Column(f"'{self.second}' better", ".0%"),
            *columns("p|.2g"),
        )
        rows = []
        for one in self.differences:
            column = COMPARED[one.name]
            sure = one.low > 0 or one.high < 0
            good = (one.difference > 0) == (column.better > 0)
            cells = (column.label, *astuple(one)[1:])
            rows.append(Row(cells, marks={3: "good" if good else "bad"} if sure else {}))
        title = f"{self.protocol}: '{self.second}' minus '{self.first}'"
        told = f"{self.images} images, paired; {interval(self)}"
        return Table("comparison", title, headings, tuple(rows), (*notes, told))


def sizes_told(first: str, one: Sequence[int], second: str, two: Sequence[int]) -> str:
    """Return a sentence about two evaluations without ground truth on images of different sizes, height x width."""
    sizes = [f"{height}x{width}" for height, width in (one, two)]
    return (
        f"{first} was scored at {sizes[0]} (height x width) and {second} at {sizes[1]}, and photometric errors depend "
        f"on the image size, so they are not comparable; compare models trained at one size, such as size={sizes[0]}"
    )


def interval(of: Spread | Comparison) -> str:
    """Return how intervals were computed, such as ``95 % bootstrap over 28 drives``."""
    note = f"{of.level:.0%} bootstrap over {of.groups} {of.by}s".replace("%", " %")
    return note if of.by == "drive" else f"{note}; neighboring frames are similar, so this is too narrow"

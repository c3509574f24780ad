"""How well a prediction preserves shapes: depth edges, and the points in space."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import distance_transform_edt, gaussian_filter, sobel
from scipy.spatial import cKDTree

FARTHEST_EDGE = 10.0
"""Largest distance in pixels between a predicted and a true edge; also the error if there is none."""
DENSE = 0.5
"""Smallest fraction of known pixels for a ground truth dense enough to have depth edges between neighbors."""
_LOW, _HIGH, _FIXED_POINT = 0.1, 0.2, 800


def boundaries(depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Find the edges of a dense depth map in meters: Canny's method on log depth, as in the evaluation of SYNS-Patches.

    Gaussian blur with sigma 1, Sobel gradients, hysteresis between 0.1 and 0.2 (Spencer et al., Deconstructing
    self-supervised monocular reconstruction, 2022). Steps of more than about 6 % of the depth are edges.
    """
    smooth = gaussian_filter(np.log(depth.astype(np.float64)), 1.0, mode="nearest")
    along = [sobel(smooth, axis=axis, mode="nearest") * _FIXED_POINT for axis in (1, 0)]
    across, down = (np.clip(np.rint(each), -32768, 32767).astype(np.int16) for each in along)
    found: ndarray = cv2.Canny(across, down, _LOW * _FIXED_POINT, _HIGH * _FIXED_POINT, L2gradient=True)
    return found > 0


def boundary_scores(
    prediction: Float[ndarray, "h w"], truth: Float[ndarray, "h w"], counted: Bool[ndarray, "h w"]
) -> tuple[float, float]:
    """Compare the edges of a prediction with those of a dense truth (Koch et al., IBims-1, 2018).

    Args:
        prediction: Depth in meters, above 0 everywhere.
        truth: Depth in meters, 0 where unknown; unknown pixels make no edges.
        counted: The pixels of the truth that a protocol compares.

    Returns:
        Accuracy, the mean distance in pixels from predicted edges to the nearest true one, over those nearer than
        `FARTHEST_EDGE`, which is the result if there are none; and completeness, the mean distance from true edges to
        the nearest predicted one. NaN for a truth that is sparse or without edges.
    """
    known = truth > 0
    if known.mean() < DENSE:
        return np.nan, np.nan
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    true = boundaries(truth[tuple(nearest)]) & known & counted
    if not true.any():
        return np.nan, np.nan
    found, to_true = boundaries(prediction), distance_transform_edt(~true)
    near = found & (to_true < FARTHEST_EDGE)
    if not near.any():
        return FARTHEST_EDGE, FARTHEST_EDGE
    return float(to_true[near].mean()), float(distance_transform_edt(~found)[true].mean())


def points(depth: Float[ndarray, " n"], mask: Bool[ndarray, "h w"], K: Float[ndarray, "3 3"]) -> Float[ndarray, "n 3"]:
    """Return the points in the camera's frame of a mask's pixels at their depths, row by row."""
    row, column = np.nonzero(mask)
    rays = np.stack([column, row, np.ones_like(row)], 1) @ np.linalg.inv(K.astype(np.float64)).T
    found: ndarray = rays * depth[:, None]
    return found


def cloud_scores(
    predicted: Float[ndarray, "n 3"], true: Float[ndarray, "m 3"], threshold: float
) -> tuple[float, float, float]:
    """Compare two point clouds (Ornek et al., From 2D to 3D: re-thinking benchmarking of monocular depth, 2022).

    Args:
        predicted: Points in meters.
        true: Points in meters.
        threshold: Meters below which points are near each other.

    Returns:
        Precision, the fraction of predicted points near a true one; recall, the fraction of true points near a
        predicted one; and the F-score, their harmonic mean, 0 if both are. NaN without points.
    """
    if len(predicted) == 0 or len(true) == 0:
        return np.nan, np.nan, np.nan
    pairs = ((predicted, true), (true, predicted))
    reached = [cKDTree(to).query(of, distance_upper_bound=threshold)[0] for of, to in pairs]
    precision, recall = (float(np.isfinite(each).mean()) for each in reached)
    return precision, recall, 2 * precision * recall / (precision + recall) if precision + recall else 0.0

"""A path as a picture: from above, and how far off it is along the way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from saunet.errors import require_matplotlib
from saunet.evaluation.odometry import Path3d, PathErrors
from saunet.io.atomic import replacing


def draw_path(path: Path3d, file: Path, errors: Sequence[PathErrors] = ()) -> None:
    """Draw a path from above, beside the true one where it is known, and the distance between them.

    Args:
        path: The path; its world's x is to the right and z is forward, as KITTI's.
        file: Picture file to write; its suffix chooses the format.
        errors: Of the path, and of predictors that look at no image, to stand in the title.

    Raises:
        ConfigError: if matplotlib is not installed.
        DataError: if the file cannot be written.
    """
    require_matplotlib("figure=true needs", "figure=false")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.5) if path.true is not None else (5, 4.5), layout="constrained")
    above, *more = figure.subplots(1, 2 if path.true is not None else 1, squeeze=False)[0]
    ours = path.aligned[:, :3, 3]
    unit = "m" if path.true is not None else "network's own unit"
    if path.true is not None:
        theirs = path.true[:, :3, 3]
        above.plot(theirs[:, 0], theirs[:, 2], color="0.45", linewidth=4, alpha=0.6, label="true")
        driven = np.concatenate(([0.0], np.linalg.norm(np.diff(theirs, axis=0), axis=1).cumsum()))
        off = np.linalg.norm(ours - theirs, axis=1)
        more[0].plot(driven, off, color="tab:red")
        more[0].set(xlabel="distance driven (m)", ylabel="distance from the true position (m)", ylim=(0, None))
        more[0].set_title(f"off by {np.sqrt((off**2).mean()):.2f} m (root mean square)", fontsize=10)
        more[0].grid(alpha=0.3)
    label = "predicted,\n7-DoF aligned" if path.true is not None else "predicted"
    above.plot(ours[:, 0], ours[:, 2], color="tab:red", linewidth=1.5, label=label)
    above.plot(ours[0, 0], ours[0, 2], "o", color="tab:red", markersize=6, label="start")
    # Equal scales, and room to the sides of a straight road, which would otherwise be a line in a sliver.
    spots = ours if path.true is None else np.concatenate([ours, path.true[:, :3, 3]])
    center, reach = (spots.max(0) + spots.min(0)) / 2, max(np.ptp(spots[:, 0]), np.ptp(spots[:, 2]), 1e-6) * 0.55
    above.set(xlim=(center[0] - reach, center[0] + reach), ylim=(center[2] - reach, center[2] + reach))
    above.set(xlabel=f"x to the right ({unit})", ylabel=f"z forward ({unit})", aspect="equal")
    above.set_title(path.sequence, fontsize=10)
    if errors:
        figure.suptitle("\n".join(map(_told, errors)), fontsize=9)
    above.legend(fontsize=8)
    above.grid(alpha=0.3)
    with replacing(file) as partial:
        figure.savefig(partial, dpi=150)


def _told(errors: PathErrors) -> str:
    """Say how good a path is before any alignment could flatter it, and how far that had to turn it."""
    relative = f", t_rel {errors.t_rel:.1f} %" if errors.segments else ""
    snippets = f"{errors.snippet}-frame ATE {errors.snippet_ate:.4f} m"
    return f"{errors.predictor}: {snippets}{relative}, turned by {errors.turn:.0f}° to align"

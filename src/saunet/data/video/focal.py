"""The focal length from driving video itself: tracked points, bundle adjustment of short windows, and uncertainty.

Two views of a car on a steady curve never determine it, and straight motion hardly does. So windows of several frames
are solved with a free focal length, each with its uncertainty, and only what the windows agree on counts.

Lens distortion changes the focal length much more than the residuals: k1 = -0.1 makes it 22 % too long. So the windows
are also solved for several strengths of the division model, which needs no focal length to correct, and for several
centers.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.data.loading.sampling import evenly
from saunet.errors import DataError
from saunet.geometry.tracks import follow

F64 = NDArray[np.float64]
Tracked = tuple[F64, NDArray[np.bool_], tuple[int, int]]
"""The result of `track` for a window, and the size of its pictures, (height, width)."""
WINDOW = 12
"""Frames solved together, about one second."""
STEP = 0.1
"""Seconds between its frames."""
WIDTH = 620
"""Pictures are resized to this width."""
KNOWN = 0.015
"""Largest relative standard deviation for a focal length to count as known."""
_TELLING = 0.04
"""Largest relative standard deviation that is good enough to detect a wrong focal length."""
_VAGUE = 2 * KNOWN
"""Below this, the road is straight: no lens can replace turns."""
_AXES = ("bend", "right", "down")
"""How a lens may differ from a straight one with its center in the middle."""
_COARSE = (0.2, 0.03, 0.03)
"""Steps in these while they are searched."""
_FINE = (0.05, 0.01, 0.01)
"""Steps around the best ones: two to each side, whose residuals a parabola averages."""
_LEAST = (0.05, 0.005, 0.005)
"""What is smaller counts as nothing."""
_SHARPEST = 10
"""Windows that are solved for each lens; three are needed, and of six the doubt is mostly chance."""
_MODEL = 0.2
"""Doubt about the form of the lens, as a share of what its bend changes the focal length by, where half a picture is as
wide as a focal length; it falls with the fourth power."""
_START = 0.8
"""Initial focal length, in picture widths."""
_SYSTEMATIC = 0.003
"""Smallest uncertainty of one window, whatever its residuals: the center and the lens are assumed."""
_SCALES, _ITERATIONS = (0.05, 0.01, 0.002, 0.0006), 15
"""Residuals, in widths, from which Cauchy's weights fall: large ones first, so that a far start finds its way."""
_FEWEST = 60
"""Fewest points of a window."""


@dataclass(frozen=True, slots=True)
class WindowFocal:
    """The estimate from one window."""

    focal: float
    """In picture widths."""
    uncertainty: float
    """Relative standard deviation."""
    error: float
    """Root mean square of the residuals, pixels."""


def track(frames: Sequence[NDArray[np.uint8]]) -> tuple[F64, NDArray[np.bool_]]:
    """Track points of the last frame backwards: in that direction a driving camera keeps seeing them.

    Returns pixels (n, frames, 2) and where they are known (n, frames), the last frame first.
    """
    gray = frames[::-1]
    corners: Any = cv2.goodFeaturesToTrack(gray[0], 600, 0.005, 7)
    if corners is None or len({each.shape for each in frames}) > 1:
        return np.zeros((0, len(frames), 2)), np.zeros((0, len(frames)), dtype=bool)
    points = np.asarray(corners, np.float32).reshape(-1, 1, 2)
    found, known = [points[:, 0].astype(np.float64)], [np.ones(len(points), dtype=bool)]
    for before, after in itertools.pairwise(gray):
        points, good = follow(before, after, points, tolerance=0.3, margin=2)
        found.append(points[:, 0].astype(np.float64))
        known.append(known[-1] & good)
    return np.stack(found, axis=1), np.stack(known, axis=1)


def solve_window(
    pixels: F64,
    known: NDArray[np.bool_],
    size: tuple[int, int],
    center: tuple[float, float] | None = None,
    bend: float = 0.0,
    right: float = 0.0,
    down: float = 0.0,
) -> WindowFocal | None:
    """Bundle-adjust a window of tracked pixels (n, frames, 2) of pictures of a size (height, width).

    ``center`` is where the principal point is expected, in pixels, by default in the picture's middle.
    """
    height, width = size
    middle = np.array(center or ((width - 1) / 2, (height - 1) / 2))
    return solve_points((pixels - middle) / width, known, width, bend, right, down)


def solve_points(
    x: F64, known: NDArray[np.bool_], width: int, bend: float = 0.0, right: float = 0.0, down: float = 0.0
) -> WindowFocal | None:
    """Bundle-adjust a window: poses, inverse depths along the rays of the first view, and one focal length.

    Args:
        x: Points (n, frames, 2) from where the center is expected, in picture widths.
        known: Where they are known (n, frames).
        width: Width of the pictures in pixels, for the error.
        bend: See `FocalEstimate`.
        right: See `FocalEstimate`.
        down: See `FocalEstimate`.

    Returns:
        None if too few points are tracked, or no focal length fits.
    """
    use = known.sum(1) >= 5
    if use.sum() < _FEWEST:
        return None
    x = x[use] - np.array([right, down])
    fit = _adjust(x / (1 + bend * (x**2).sum(-1, keepdims=True)), known[use], _START)
    return fit and WindowFocal(fit[0], fit[1], fit[2] * width)


@dataclass(frozen=True, slots=True)
class FocalEstimate:
    """The estimate from all windows together."""

    focal: float
    """In picture widths."""
    uncertainty: float
    """Relative standard deviation, larger if windows disagree."""
    windows: int
    bend: float | None = 0.0
    """Of the lens: a straight picture's points are ``x / (1 + bend * |x|^2)``, in widths; 0 where none was found, None
    where time did not allow to look for it."""
    right: float = 0.0
    """Offset of the principal point from the expected one, in widths."""
    down: float = 0.0

    @property
    def distortion(self) -> float:
        """The bend as the parameter of the division model, whose radii are in focal lengths."""
        return (self.bend or 0.0) * self.focal**2

    def intrinsics(self, height: int, width: int, unit: int) -> F64:
        """Return K for a picture of this size, whose middle was the expected center; ``unit`` pixels are a width."""
        x, y = (width - 1) / 2 + self.right * unit, (height - 1) / 2 + self.down * unit
        return np.array([[self.focal * unit, 0, x], [0, self.focal * unit, y], [0, 0, 1]])

    @property
    def assumed(self) -> str:
        """The assumptions to report with the estimate."""
        bent = f"distortion {self.distortion:.3f} in the division model" if self.bend else "no distortion found"
        if self.bend is None:
            bent = "distortion was not checked, and would make it too long"
        elsewhere = f"center {self.right:+.1%} of the width to the right of and {self.down:+.1%} below the middle"
        return f"{bent}; {elsewhere if self.right or self.down else 'center in the middle'}"

    @property
    def is_known(self) -> bool:
        return self.windows >= 3 and self.uncertainty <= KNOWN

    @property
    def tells(self) -> bool:
        """Whether an error of 20 % would be noticed: four standard deviations are less than that."""
        return self.windows >= 3 and self.uncertainty <= _TELLING and self.bend is not None

    def contradicts(self, focal: float) -> bool:
        """Return whether a given focal length, in picture widths, contradicts the pictures."""
        return self.tells and abs(math.log(focal / self.focal)) > max(4 * self.uncertainty, 0.08)


def combined(found: Sequence[WindowFocal]) -> FocalEstimate | None:
    """Return the weighted mean of windows, without outliers; None if there is none."""
    logs = np.log([each.focal for each in found])
    spread = np.maximum([each.uncertainty for each in found], _SYSTEMATIC)
    keep = np.isfinite(spread)
    if not keep.any():
        return None
    order = np.argsort(logs)
    order = order[keep[order]]
    share = np.cumsum(1 / spread[order] ** 2)
    middle = logs[order[int(np.searchsorted(share, share[-1] / 2))]]  # the weighted median
    keep &= np.abs(logs - middle) < 4 * spread + 0.02
    weights = 1 / spread[keep] ** 2
    mean = float((weights * logs[keep]).sum() / weights.sum())
    doubt = float((weights * (logs[keep] - mean) ** 2).sum() / max(1, keep.sum() - 1))
    return FocalEstimate(float(np.exp(mean)), float(np.sqrt(max(1.0, doubt) / weights.sum())), int(keep.sum()))


def refusal(found: FocalEstimate | None, source: str) -> str:
    """Describe why a focal length cannot be estimated, and what to film."""
    known = "no turn shows it"
    if found is not None and math.isfinite(found.uncertainty):
        known = f"it looks like {found.focal:.2f} image widths, but only to within {found.uncertainty:.1%}"
    film = "film a minute with turns at 15 to 30 km/h: corners, a roundabout, a winding road"
    return f"the focal length cannot be estimated from {source}: {known} ({KNOWN:.1%} is required); {film}"


def drive_windows(drives: Sequence[Drive], most: int) -> Iterator[list[NDArray[np.uint8]]]:
    """Yield windows of gray frames as recorded, about `STEP` apart, evenly spread over recordings."""
    starts = []
    for drive in drives:
        every = max(1, round(STEP * (drive.fps or 0) / _median_step(drive)))
        span = every * (WINDOW - 1)
        for start in range(0, len(drive.indices) - span, max(1, span // 2)):
            chosen = drive.indices[start : start + span + 1 : every]
            if chosen[-1] - chosen[0] == span:  # so nothing is missing
                starts.append((drive, chosen))
    for place in evenly(len(starts), most):
        drive, chosen = starts[place]
        with suppress(DataError):  # broken frames are reported elsewhere
            yield [small_gray(drive.recorded_image(each)) for each in chosen]


def _median_step(drive: Drive) -> float:
    """Return the number of recorded frames per step of the indices."""
    numbers = [drive.recorded(index) for index in drive.indices[:100]]
    return max(1.0, float(np.median(np.diff(numbers)))) if len(numbers) > 1 else 1.0


def small_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGB picture, h x w x 3, in gray, at most `WIDTH` wide."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    width = min(WIDTH, gray.shape[1])
    size = (width, round(gray.shape[0] * width / gray.shape[1]))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)


def turning(pixels: F64, known: NDArray[np.bool_]) -> float:
    """Return how far a window's points move sideways together, in pixels: much in turns, little on straights."""
    steps = (pixels[:, 1:, 0] - pixels[:, :-1, 0])[known[:, 1:]]
    return abs(float(np.median(steps))) if len(steps) else 0.0


def estimate_focal(
    windows: Iterable[Sequence[NDArray[np.uint8]]],
    most: int = 16,
    center: tuple[float, float] | None = None,
    seconds: float = math.inf,
    free_center: bool = True,
) -> FocalEstimate | None:
    """Estimate the focal length from windows of gray frames; the ``most`` that turn most are solved.

    ``center`` is the principal point in picture widths, or where to look for it if it is ``free_center``. After
    ``seconds`` of processor time no window is begun but the three that are needed, and the lens is not looked at. None
    if no window has enough points to follow.
    """
    until = time.process_time() + seconds
    solvers = []
    for pixels, known, size in turning_most(windows, most, until - seconds / 2):
        at = None if center is None else (center[0] * size[1], center[1] * size[1])
        solvers.append(functools.partial(solve_window, pixels, known, size, at))
    return solve_together(solvers, until, free_center)


def turning_most(windows: Iterable[Sequence[NDArray[np.uint8]]], most: int, until: float) -> list[Tracked]:
    """Track windows of gray frames, and return the ``most`` that turn most, the ones that do first.

    Once the processor time is ``until`` and three windows were looked at, no other is.
    """
    best: list[tuple[float, int, Tracked]] = []
    for number, frames in enumerate(windows):
        pixels, known = track(frames)
        size = frames[0].shape[0], frames[0].shape[1]
        heapq.heappush(best, (turning(pixels, known), number, (pixels, known, size)))
        if len(best) > most:
            heapq.heappop(best)
        if number >= 2 and time.process_time() > until:
            break
    return [tracked for _, _, tracked in sorted(best, reverse=True, key=itemgetter(0))]


def solve_together(
    solvers: Sequence[Solver], until: float = math.inf, free_center: bool = True
) -> FocalEstimate | None:
    """Solve windows, and return what they say together, with the lens; see `estimate_focal`."""
    solved: list[tuple[Solver, WindowFocal]] = []
    for number, solver in enumerate(solvers):
        if number >= 3 and time.process_time() > until:
            break
        if found := solver():
            solved.append((solver, found))
    straight = [found for _, found in solved]
    if time.process_time() < until:
        return with_lens([solver for solver, _ in solved], straight, free_center)
    together = combined(straight)
    return together and replace(together, bend=None)


Solver = Callable[..., WindowFocal | None]
"""`solve_window` of one window, which takes the bend and where the center is."""


def with_lens(
    solvers: Sequence[Solver], straight: Sequence[WindowFocal], free_center: bool = True
) -> FocalEstimate | None:
    """Return what windows say together, with the bend of the lens and its center where they agree on them.

    ``straight`` has what each window says without. One after the other, each goes where the windows' squared residuals
    together are lowest: to the best coarse step, then to the lowest point of a parabola.
    """
    together = combined(straight)
    sharpest = sorted(range(len(straight)), key=lambda index: straight[index].uncertainty)[:_SHARPEST]
    if together is None or len(sharpest) < 3 or together.uncertainty > _VAGUE:
        return together and replace(together, bend=None)
    unknown = replace(together, uncertainty=math.inf)

    @functools.cache
    def solve(lens: tuple[float, ...]) -> list[WindowFocal] | None:
        about = dict(zip(_AXES, lens, strict=True))
        found = [solvers[index](**about) if any(lens) else straight[index] for index in sharpest]
        return None if None in found else [each for each in found if each]

    def costs(lens: tuple[float, ...]) -> F64:
        """Return minus twice the logarithm of each window's likelihood, up to a factor and a constant."""
        return np.log([each.error**2 for each in found]) if (found := solve(lens)) else np.full(len(sharpest), np.inf)

    best, axes = tuple(0.0 for _ in _AXES), range(3 if free_center else 1)

    def moved(axis: int, by: float) -> tuple[float, ...]:
        return tuple(round(value + by * (axis == place), 4) for place, value in enumerate(best))

    def table(axis: int, steps: Sequence[float]) -> F64:
        return np.array([costs(moved(axis, step)) for step in steps])

    # a free center twice: one aside looks like a bend as long as it is not found
    for axis in (*axes, *axes) if free_center else axes:
        for way in (-_COARSE[axis], _COARSE[axis]):
            while abs(moved(axis, way)[axis]) < 1 and costs(moved(axis, way)).sum() < costs(best).sum():
                best = moved(axis, way)
        steps = (-_COARSE[axis], 0.0, _COARSE[axis])
        best = moved(axis, _lowest(steps, table(axis, steps).sum(1)) or 0.0)
    doubts = []
    for axis in axes:
        fine = tuple(_FINE[axis] * place for place in (-2, -1, 0, 1, 2))
        measured = table(axis, fine)
        low = _lowest(fine, measured.sum(1))
        without = [_lowest(fine, np.delete(measured, window, 1).sum(1)) for window in range(len(sharpest))]
        near, far = solve(moved(axis, fine[0])), solve(moved(axis, fine[-1]))
        if low is None or None in without or near is None or far is None:
            return unknown
        lows = np.array(without, np.float64)
        deviation = math.sqrt((len(lows) - 1) * float(lows.var()))  # the jackknife
        slope = math.log(np.median([each.focal for each in far]) / np.median([each.focal for each in near]))
        doubts.append(slope / (fine[-1] - fine[0]) * deviation)
        best = moved(axis, low)
        if abs(best[axis]) < max(4 * deviation, _LEAST[axis]):
            best = moved(axis, -best[axis])
    if not any(best):
        return replace(together, uncertainty=math.hypot(together.uncertainty, *doubts))
    bend, right, down = best
    bent = combined([each for solver in solvers if (each := solver(bend=bend, right=right, down=down))])
    if bent is None:
        return unknown
    wide = (0.5 / bent.focal) ** 4
    model = _MODEL * wide * math.log(bent.focal / together.focal) if bend else 0.0
    doubt = math.hypot(bent.uncertainty, *doubts, model)
    return replace(bent, uncertainty=doubt, bend=bend, right=right, down=down)


def _lowest(places: Sequence[float], costs: F64) -> float | None:
    """Return where the parabola through costs is lowest, not beyond the places; None if it opens downwards."""
    if not np.isfinite(costs).all():
        return None
    square, line, _ = np.polyfit(places, costs, 2)
    return float(np.clip(-line / (2 * square), places[0], places[-1])) if square > 0 else None


def _adjust(x: F64, known: NDArray[np.bool_], focal: float) -> tuple[float, float, float] | None:
    """Return the focal length, its relative deviation, and the error; coordinates are in widths."""
    count, views = known.shape
    t = np.zeros((views, 3))
    t[:, 2] = np.arange(views)  # earlier views lie behind: points are farther from them
    state: Any = np.tile(np.eye(3), (views, 1, 1)), t, np.full(count, 1 / 15), focal
    seen = known.copy()
    seen[:, 0] = False
    for scale in _SCALES:
        damping, cost = 1e-3, _cost(x, seen, state, scale)
        for _ in range(_ITERATIONS):
            A, b, B, C, d, r = _normal(x, seen, state, scale)
            after = np.inf
            while damping < 1e6:
                Cd = C * (1 + damping)
                S = A + damping * np.diag(np.diag(A) + 1e-6 * A.max()) - (B / Cd[:, None]).T @ B
                delta = np.linalg.solve(S, B.T @ (d / Cd) - b)
                trial = _moved(state, np.asarray(delta, np.float64), np.asarray(-(d + B @ delta) / Cd, np.float64))
                after = _cost(x, seen, trial, scale)
                if after < cost:
                    break
                damping *= 6
            if not after < cost:
                break
            gain, cost, state, damping = cost - after, after, trial, max(damping / 6, 1e-9)
            if gain < 1e-5 * cost:
                break
    A, b, B, C, d, r = _normal(x, seen, state, scale)
    far = np.linalg.norm(r, axis=2)
    inliers, focal = seen & (far < 3 * scale), state[3]
    if not 0.2 < focal < 10 or inliers.sum() < 0.5 * seen.sum():
        return None
    rows = 2 * int(inliers.sum())
    squares = float((far[inliers] ** 2).sum())
    values, vectors = np.linalg.eigh(A - (B / C[:, None]).T @ B)
    variance = squares / max(1, rows - len(A) - count)
    deviation = np.sqrt(variance * (vectors[-1, 1:] ** 2 / values[1:].clip(values[-1] * 1e-15)).sum())  # 0: the scale
    return float(focal), float(deviation / focal), float(np.sqrt(squares / rows))


def _normal(x: F64, seen: NDArray[np.bool_], state: Any, scale: float) -> tuple[F64, F64, F64, F64, F64, F64]:
    """Return the normal equations: of poses and focal length, across, and of the points, each with its right side."""
    count, views = seen.shape
    r, Jc, Jd = _residuals(x, *state)
    w = np.where(seen, 1 / (1 + (r**2).sum(2) / scale**2), 0.0)
    H, g = (
        np.einsum("nvka,nvkb,nv->vab", Jc, Jc, w, optimize=True),
        np.einsum("nvka,nvk,nv->va", Jc, r, w, optimize=True),
    )
    cross = np.einsum("nvka,nvk,nv->nva", Jc, Jd, w, optimize=True)
    C, d = np.einsum("nvk,nvk,nv->n", Jd, Jd, w) + 1e-12, np.einsum("nvk,nvk,nv->n", Jd, r, w)
    dims = 6 * (views - 1) + 1
    A, b, B = np.zeros((dims, dims)), np.zeros(dims), np.zeros((count, dims))
    for view in range(1, views):
        at = slice(6 * (view - 1), 6 * view)
        A[at, at], A[at, -1], b[at], B[:, at] = H[view, :6, :6], H[view, :6, 6], g[view, :6], cross[:, view, :6]
    A[-1] = A[:, -1]
    A[-1, -1], b[-1], B[:, -1] = H[:, 6, 6].sum(), g[:, 6].sum(), cross[:, :, 6].sum(1)
    return A, b, B, C, d, r


def _project(x: F64, R: F64, t: F64, depth: F64, focal: float) -> tuple[F64, F64]:
    rays = np.concatenate([x[:, 0] / focal, np.ones((len(x), 1))], axis=1)
    turned = np.einsum("vij,nj->nvi", R, rays)
    return turned, turned + depth[:, None, None] * t[None]


def _cost(x: F64, seen: NDArray[np.bool_], state: Any, scale: float) -> float:
    R, t, depth, focal = state
    if not 0.1 < focal < 20:
        return np.inf
    _, Y = _project(x, R, t, depth, focal)
    with np.errstate(all="ignore"):
        size = np.linalg.norm(focal * Y[..., :2] / Y[..., 2:] - x, axis=2)
    size = np.where(Y[..., 2] > 0.05, size, 1.0)
    return float((np.log1p((size / scale) ** 2) * seen).sum())


def _residuals(x: F64, R: F64, t: F64, depth: F64, focal: float) -> tuple[F64, F64, F64]:
    """Return residuals (n, views, 2), and what they change by per pose and focal length (.., 7), and per depth."""
    turned, Y = _project(x, R, t, depth, focal)
    z = np.maximum(Y[..., 2], 0.05)
    seen = focal * Y[..., :2] / z[..., None]
    P = np.zeros((*Y.shape[:2], 2, 3))
    P[..., 0, 0] = P[..., 1, 1] = focal / z
    P[..., :, 2] = -seen / z[..., None]
    cross = np.zeros((*Y.shape[:2], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = turned[..., 2], -turned[..., 1], turned[..., 0]
    cross -= np.swapaxes(cross, -1, -2)
    Jc = np.zeros((*Y.shape[:2], 2, 7))
    Jc[..., :3] = P @ cross
    Jc[..., 3:6] = P * depth[:, None, None, None]
    bent = np.concatenate([-x[:, 0] / focal**2, np.zeros((len(x), 1))], axis=1)
    Jc[..., 6] = np.einsum("nvki,nvi->nvk", P, np.einsum("vij,nj->nvi", R, bent)) + seen / focal
    Jd = np.einsum("nvki,vi->nvk", P, t)
    return seen - x, Jc, Jd


def _moved(state: Any, delta: F64, inverse: F64) -> Any:
    R, t, depth, focal = state
    R, t = R.copy(), t.copy()
    for view in range(1, len(R)):
        turn, shift = delta[6 * (view - 1) : 6 * view][:3], delta[6 * (view - 1) : 6 * view][3:]
        R[view] = cv2.Rodrigues(turn)[0] @ R[view]
        t[view] += shift
    return R, t, np.maximum(depth + inverse, 1e-6), focal + float(delta[-1])

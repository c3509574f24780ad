"""Lens models: the projection of rays, the radius up to which it is valid, and the undistorted picture that fits.

x, y are on the image plane at distance 1, before K. Sources: OpenCV's `calib3d` and `fisheye`, COLMAP's `models.h`, Mei
2007 (omni), Devernay 2001 (fov), Fitzgibbon 2001 (division), Khomutenko 2016 (eucm), Usenko 2018 (double_sphere).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from saunet.errors import CameraError

COEFFICIENTS = {
    "pinhole": (0, 4, 5, 8, 12, 14),
    "fisheye": (0, 1, 2, 3, 4),
    "thin_prism_fisheye": (8,),
    "omni": (5,),
    "fov": (1,),
    "division": (1,),
    "eucm": (2,),
    "double_sphere": (2,),
}
"""Number of distortion coefficients of each model; see docs/cameras.md for their order."""
WIDEST = 120.0
"""Widest undistorted picture in horizontal degrees: beyond, its corners are mostly interpolated."""
Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]


def project(model: str, coefficients: Sequence[float], rays: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Return x, y of rays of any length, NaN where the lens shows no such ray."""
    X, Y, Z = (np.asarray(rays[..., axis], np.float64) for axis in range(3))
    rho, length = np.hypot(X, Y), np.linalg.norm(rays, axis=-1)
    k = np.zeros(14)
    k[: len(coefficients)] = coefficients
    with np.errstate(all="ignore"):
        if model == "pinhole":
            flat = np.ascontiguousarray(rays, np.float64).reshape(-1, 1, 3)
            still = np.zeros(3)
            seen = np.reshape(cv2.projectPoints(flat, still, still, np.eye(3), k)[0], (*rays.shape[:-1], 2))
            shown: NDArray[np.float64] = np.where((Z > 0)[..., None], seen, np.nan)
            return shown
        if model in ("fisheye", "thin_prism_fisheye"):
            theta = np.arctan2(rho, Z)
            ratio: NDArray[np.float64] = np.where(rho > 0, theta / rho, 1)
            u, v = ratio * X, ratio * Y
            q = theta**2
            if model == "fisheye":
                scale = 1 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3])))
                return np.stack([u * scale, v * scale], -1)
            scale = 1 + q * (k[0] + q * (k[1] + q * (k[4] + q * k[5])))
            return np.asarray(_tangential(u, v, scale, k[2], k[3]) + np.stack([k[6] * q, k[7] * q], -1))
        if model == "omni":
            depth = Z + k[0] * length
            # with xi > 1 rays behind the mirror's horizon come back over the picture
            depth = np.where((depth > 0) & (k[0] * Z + length > 0), depth, np.nan)
            u, v = X / depth, Y / depth
            q = u**2 + v**2
            return _tangential(u, v, 1 + q * (k[1] + q * k[2]), k[3], k[4])
        if model == "fov":
            radius = np.arctan2(2 * np.tan(k[0] / 2) * rho, Z) / k[0]
        elif model == "division":
            radius = 2 * rho / (Z + np.sqrt(Z**2 - 4 * k[0] * rho**2))
        elif model == "eucm":
            radius = rho / (k[0] * np.sqrt(k[1] * rho**2 + Z**2) + (1 - k[0]) * Z)
        else:  # double_sphere
            shifted = k[0] * length + Z
            radius = rho / (k[1] * np.hypot(rho, shifted) + (1 - k[1]) * shifted)
        scale = np.where(rho > 0, np.where(radius >= 0, radius / rho, np.nan), 0)
        return np.stack([scale * X, scale * Y], -1)


def _tangential(
    u: NDArray[np.float64], v: NDArray[np.float64], radial: NDArray[np.float64], p1: float, p2: float
) -> NDArray[np.float64]:
    q = u**2 + v**2
    return np.stack(
        [
            u * radial + 2 * p1 * u * v + p2 * (q + 2 * u**2),
            v * radial + 2 * p2 * u * v + p1 * (q + 2 * v**2),
        ],
        -1,
    )


def pixels(
    model: str, coefficients: Sequence[float], K: NDArray[np.float64], rays: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 2"]:
    """Return the pixels of rays, NaN where the lens shows no such ray."""
    return project(model, coefficients, rays) @ K[:2, :2].T + K[:2, 2]


def fold(
    model: str, coefficients: Sequence[float], K: NDArray[np.float64], height: int, width: int
) -> tuple[float, float]:
    """Return where the model folds back inside a picture, as (radians off the axis, pixels off the center); else inf.

    Beyond that radius no ray of the model arrives: its numbers were fitted to the middle of the picture only.
    """
    around = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    angles = np.linspace(0, np.pi / 2 - 0.01 if model == "pinhole" else np.pi, 2000)
    sines, cosines = np.sin(angles)[:, None], np.repeat(np.cos(angles)[:, None], len(around), 1)
    seen = project(model, coefficients, np.stack([sines * np.cos(around), sines * np.sin(around), cosines], -1))
    grows = np.diff(np.linalg.norm(seen, axis=-1), axis=0) > 0  # NaN does not grow
    last = np.where(grows.all(0), len(angles) - 1, grows.argmin(0))
    ends = np.stack([seen[place, column] for column, place in enumerate(last)])
    with np.errstate(invalid="ignore"):  # a NaN is no pixel inside
        ends = ends @ K[:2, :2].T
    at = ends + K[:2, 2]
    inside = (at >= 0).all(1) & (at[:, 0] <= width - 1) & (at[:, 1] <= height - 1) & (last < len(angles) - 1)
    if not inside.any():
        return np.inf, np.inf
    return float(angles[last[inside]].min()), float(np.linalg.norm(ends[inside], axis=1).min())


def straight_intrinsics(
    model: str,
    coefficients: Sequence[float],
    K: NDArray[np.float64],
    height: int,
    width: int,
    fov: float | None,
    where: str,
) -> NDArray[np.float64]:
    """Return K of an undistorted picture of the same size without blank pixels: the widest, or ``fov`` degrees wide.

    Args:
        model: The lens model.
        coefficients: Its distortion coefficients.
        K: K of the recorded picture.
        height: Height of both pictures.
        width: Width of both pictures.
        fov: Horizontal field of view; None for the widest, at most `WIDEST`. OpenCV chooses for pinhole lenses; for
            others the optical axis stays where it is and pixels keep their shape.
        where: The file, for messages.

    Raises:
        CameraError: if the model folds back inside the used part of the picture, or ``fov`` is too wide.
    """
    limit, radius = fold(model, coefficients, K, height, width)

    def straight(degrees: float) -> NDArray[np.float64]:
        focal = width / 2 / np.tan(np.radians(degrees) / 2)
        return np.array([[focal, 0, K[0, 2]], [0, focal * K[1, 1] / K[0, 0], K[1, 2]], [0, 0, 1]])

    def fits(candidate: NDArray[np.float64], angle: float = limit) -> bool:
        u, v = np.linspace(0, width - 1, 65), np.linspace(0, height - 1, 65)
        edges = np.concatenate(
            [[(x, y) for x in u for y in (0, height - 1)], [(x, y) for y in v for x in (0, width - 1)]]
        )
        rays = rays_of(candidate, edges)
        at = pixels(model, coefficients, K, rays)
        inside = (at > -1).all() and (at[:, 0] < width).all() and (at[:, 1] < height).all()
        return bool(inside and np.arctan(np.hypot(rays[:, 0], rays[:, 1]).max()) < angle)

    widest, high = (WIDEST, WIDEST) if fits(straight(WIDEST)) else (1.0, WIDEST)
    while high - widest > 0.01:
        middle = (widest + high) / 2
        widest, high = (middle, high) if fits(straight(middle)) else (widest, middle)
    if fov is not None:
        if fov > widest + 0.05:
            raise CameraError(
                f"{where}: fov is {fov:g}, but the undistorted picture of this lens is at most {widest:.0f} degrees "
                "wide; choose a smaller fov"
            )
        return straight(fov)
    if limit < np.inf and (model == "pinhole" or (widest < WIDEST and fits(straight(widest + 1), np.inf))):
        raise CameraError(
            f"{where}: this lens model folds back {radius:.0f} pixels from the center, inside the picture, and is "
            f"invalid beyond; calibrate with the board in the corners too, or set fov to at most {widest:.0f} "
            "degrees in camera.yaml to use only the middle (saunet calibrate converts other files)"
        )
    if model == "pinhole" and not K[0, 1]:  # OpenCV overlooks skew
        size = (width, height)
        optimal = np.array(cv2.getOptimalNewCameraMatrix(K, np.array(coefficients), size, 0.0, size)[0], np.float64)
        own = straight(widest)  # wider only where OpenCV's five iterations did not converge
        if fits(optimal) and optimal[0, 0] * optimal[1, 1] < 1.05 * own[0, 0] * own[1, 1]:
            return optimal
    return straight(widest)


def rays_of(K: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays of pixels of a straight picture, z = 1."""
    return np.concatenate([(at - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(at), 1))], axis=1)


def seen_rays(
    model: str, coefficients: Sequence[float], K: NDArray[np.float64], at: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 3"]:
    """Return the rays of pixels of a recorded picture, z = 1; NaN beyond a fold, and half of `WIDEST` off the axis.

    Newton's method in angles, from the mean radius of each angle; the inverse of `pixels`.
    """
    target = np.linalg.solve(K[:2, :2], (at - K[:2, 2]).reshape(-1, 2).T).T
    if not len(target):
        return np.empty((*at.shape[:-1], 3))
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    angles = np.linspace(0, np.radians(WIDEST / 2), 1000)

    def shown(flat: NDArray[np.float64]) -> NDArray[np.float64]:
        angle = np.linalg.norm(flat, axis=-1)
        across = np.sinc(angle / np.pi)[:, None] * flat
        return project(model, coefficients, np.concatenate([across, np.cos(angle)[:, None]], axis=-1))

    circle = np.stack([np.cos(around), np.sin(around)], -1)
    spokes = shown((angles[:, None, None] * circle).reshape(-1, 2))
    radii = np.linalg.norm(spokes, axis=-1).reshape(len(angles), -1).mean(1)
    grows = np.append(np.diff(radii) > 0, False)  # NaN does not grow
    last = int(grows.argmin())
    length = np.linalg.norm(target, axis=-1)
    inside = length <= radii[last]
    angle = np.interp(length, radii[: last + 1], angles[: last + 1])
    flat = target * (angle / np.where(length > 0, length, 1))[:, None]
    step = 1e-6
    for _ in range(6):
        now = shown(flat)
        columns = [(shown(flat + step * np.eye(2)[axis]) - now) / step for axis in range(2)]
        J = np.stack(columns, -1)
        J[~np.isfinite(J).all((1, 2))] = np.eye(2)  # beyond what the lens shows
        J[np.abs(np.linalg.det(J)) < 1e-3] = np.eye(2)
        flat = flat - np.linalg.solve(J, np.nan_to_num(now - target)[..., None])[..., 0]
    angle = np.linalg.norm(flat, axis=-1)
    inside &= (np.linalg.norm(shown(flat) - target, axis=-1) < 1e-6) & (angle <= angles[last])
    across = np.where(inside[:, None], flat * (np.tan(angle) / np.where(angle > 0, angle, 1))[:, None], np.nan)
    return np.concatenate([across, np.where(inside, 1.0, np.nan)[:, None]], axis=-1).reshape(*at.shape[:-1], 3)


def straightening_maps(
    model: str,
    coefficients: Sequence[float],
    K: NDArray[np.float64],
    straight: NDArray[np.float64],
    height: int,
    width: int,
) -> Maps:
    """Return, for OpenCV's `remap`, where each pixel of a straight picture comes from."""
    if model == "pinhole" and not K[0, 1]:
        numbers = np.array(coefficients)
        first, second = cv2.initUndistortRectifyMap(K, numbers, None, straight, (width, height), cv2.CV_16SC2)
        return np.asarray(first), np.asarray(second)
    from_where = np.empty((height, width, 2), np.float32)
    columns = np.arange(width, dtype=np.float64)
    for row in range(height):  # row by row: large pictures need little memory
        at = np.stack([columns, np.full(width, float(row))], axis=1)
        from_where[row] = pixels(model, coefficients, K, rays_of(straight, at))
    first, second = cv2.convertMaps(from_where[..., 0], from_where[..., 1], cv2.CV_16SC2)
    return np.asarray(first), np.asarray(second)

"""Findings and the manifest from measurements: what is wrong, what to do, and which frames to leave out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from saunet.data.loading.selecting import MIN_FLOW, UNREADABLE, Manifest
from saunet.data.video.motion import CUT, PEAK
from saunet.errors import UnreadableError
from saunet.tools.doctor.survey import ABSENT, BANDS, CameraFacts, FrameFacts, Survey, is_doubled

DARK, BRIGHT = 0.08, 0.92
"""A frame with a mean brightness outside these shows nothing."""
FLAT = 0.03
"""A frame with less contrast shows nothing (fog on the lens, a wall, a cap)."""
_STILL_BAND = 0.5
"""A band that moves less than this fraction of the whole picture is part of the car."""
_UNEVEN = 1.5
"""A recording is mentioned from this ratio of highest to lowest rate on."""
_USUAL_VIEW = (60, 120)
"""Usual horizontal field of view of a car's camera, degrees."""
_USE_MANIFEST = "train with data.manifest=<this manifest>"


@dataclass(frozen=True)
class Finding:
    """One finding about a data set."""

    level: Literal["error", "warning", "note"]
    text: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.level}: {self.text}" + (f"; {self.fix}" if self.fix else "")


def diagnose(survey: Survey) -> list[Finding]:
    """Return the findings about a data set, errors first."""
    rules = (
        _splits,
        _names,
        _unreadable,
        _sizes,
        _cameras,
        _neighbors,
        _leak,
        _parallax,
        _times,
        _cuts,
        _doubled,
        _static,
        _bonnet,
    )
    found = [finding for rule in (*rules, _light, _truth, _distances, _speed) for finding in rule(survey)]
    return sorted(found, key=lambda finding: ("error", "warning", "note").index(finding.level))


def _splits(survey: Survey) -> Iterator[Finding]:
    for problem in dict.fromkeys(map(str, survey.problems.values())):
        splits = [split for split, error in survey.problems.items() if str(error) == problem]
        named = " and ".join([", ".join(splits[:-1]), splits[-1]] if len(splits) > 1 else splits)
        broken = isinstance(survey.problems[splits[0]], UnreadableError)
        text = f"the {named} split{'s' if len(splits) > 1 else ''} cannot be used: {problem}"
        yield Finding("error", text, "data.on_error=skip counts all broken files" if broken else "")
    count = survey.windows.get("train")
    if count is not None and count < 1000:
        text = f"only {count} training samples; published models use about 40 000"
        yield Finding("warning", text, "add drives, or start from a trained model")
    if count is not None and "val" not in survey.windows and "val" not in survey.problems:
        advice = f"set {' or '.join(survey.holding_out)}" if survey.holding_out else ""
        yield Finding("warning", "nothing is held out for validation", advice)


def _names(survey: Survey) -> Iterator[Finding]:
    for name in survey.ambiguous:
        text = f"'{name}' names different recordings in different splits, so a manifest cannot distinguish them"
        yield Finding("error", text, "give each recording its own name")


def _unreadable(survey: Survey) -> Iterator[Finding]:
    unreadable, lost = (
        max((reasons.get(reason, 0) for reasons in survey.left_out.values()), default=0)
        for reason in ("unreadable", "not decodable")
    )
    if unreadable:
        yield Finding("warning", f"{unreadable} frames cannot be read and are left out", "copy them again")
    if lost:
        text = f"{lost} frames that videos claim to have cannot be decoded and are left out"
        yield Finding("warning", text, "the end of a video is cut off or damaged: copy it again")
    broken = [each for each in survey.frames if each.problem and not each.of_camera]
    if broken:
        text = f"{len(broken)} of {len(survey.frames)} frames cannot be read, first of all: {broken[0].problem}"
        yield Finding("error", text, f"copy them again, or {_USE_MANIFEST} or data.on_error=skip")
    damaged = [frame for frame in survey.frames if frame.damage]
    if damaged:
        first = damaged[0]
        text = f"{len(damaged)} frames are partly damaged, such as {first.index} of '{first.drive}' ({first.damage})"
        yield Finding("warning", text, "check them, and copy them again if parts are gray or shifted")


def _sizes(survey: Survey) -> Iterator[Finding]:
    sizes: dict[str, Counter[tuple[int, int]]] = {}
    for frame in survey.readable():
        sizes.setdefault(frame.drive, Counter())[frame.size] += 1
    for drive, counts in sizes.items():
        if len(counts) > 1:
            listed = ", ".join(f"{count} of {width}x{height}" for (height, width), count in counts.most_common(3))
            yield Finding("error", f"'{drive}' mixes frame sizes: {listed}", "frames of a drive must share one size")
    if sizes:
        shapes = Counter(counts.most_common(1)[0][0] for counts in sizes.values())
        listed = ", ".join(f"{width}x{height} in {count}" for (height, width), count in shapes.most_common(4))
        yield Finding("note", f"{len(survey.readable())} frames read from {len(sizes)} drives; sizes: {listed}")


def _cameras(survey: Survey) -> Iterator[Finding]:
    yield from (Finding("error", problem) for problem in survey.camera_problems)
    if survey.camera_files:
        yield Finding("note", survey.camera_files)
    for camera in survey.cameras:
        yield from _camera(camera)
    if survey.cameras:
        views = [round(camera.view) for camera in survey.cameras]
        low, high = min(views), max(views)
        view = f"{low}{f' to {high}' if high > low else ''} degrees"
        yield Finding("note", f"horizontal field of view {view}")
    known = [camera for camera in survey.cameras if camera.estimate is not None and camera.estimate.tells]
    looked, cameras = survey.focals
    if known:
        told = f"the focal length could be estimated from the turns of {len(known)} of {len(survey.cameras)} drives"
        yield Finding("note", f"{told}; {_agreement(known)}")
    elif survey.cameras:
        unknown = (
            "the focal length cannot be estimated from any examined drive (that needs turns, and the right lens model)"
        )
        text = f"K was not checked, because {unknown}; it means a field of view of {view}"
        if _USUAL_VIEW[0] <= low and high <= _USUAL_VIEW[1]:
            yield Finding("note", text, "is this your camera's?")
        else:
            fix = "give K in pixels of the image size it was calibrated for, or calibrate (saunet calibrate)"
            yield Finding("warning", f"{text}; car cameras usually have {_USUAL_VIEW[0]} to {_USUAL_VIEW[1]}", fix)
    if cameras > looked:
        text = f"only the drives of {looked} of {cameras} different K were searched for turns"
        yield Finding("note", text, "for another one, run saunet calibrate video=DRIVE")
    heights = {camera.height for camera in survey.cameras}
    if heights and None not in heights:
        listed = ", ".join(map(str, sorted({round(height or 0, 2) for height in heights})))
        yield Finding("note", f"camera height {listed} m: depth can be made metric")


def _agreement(known: Sequence[CameraFacts]) -> str:
    """Return in how many drives K agrees with the estimated focal length."""
    wrong = sum(camera.estimate.contradicts(camera.recorded) for camera in known if camera.estimate)
    everywhere = "in all of them" if len(known) > 1 else "there"
    if wrong == 0:
        return f"K agrees with it {everywhere}"
    if wrong == len(known):
        return f"K contradicts it {everywhere}"
    return f"K agrees with it in {len(known) - wrong} and contradicts it in {wrong}"


def _camera(camera: CameraFacts) -> Iterator[Finding]:
    (height, width), K = camera.size, camera.K
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    told = f"'{camera.drive}': fx {fx:.1f}, fy {fy:.1f}, center {cx:.1f}, {cy:.1f} in {width}x{height}"
    if not 20 <= camera.view <= 150:
        text = f"{told} means a field of view of {camera.view:.0f} degrees, which no driving camera has"
        yield Finding("error", text, "give K in pixels of the image size it was calibrated for")
    elif abs(fx / fy - 1) > 0.1:
        yield Finding("warning", f"{told}: the focal lengths differ", "were images stretched after calibration?")
    found = camera.estimate
    if found is not None and found.contradicts(camera.recorded):
        given, off = camera.recorded * width, camera.recorded / found.focal - 1
        text = (
            f"'{camera.drive}': K's focal length is {abs(off):.0%} too {'long' if off > 0 else 'short'}: it is "
            f"{given:.1f} pixels, and the turns in the pictures give {found.focal * width:.1f}, known to within "
            f"{found.uncertainty:.1%} (both before any undistortion, as in camera.yaml)"
        )
        fix = (
            "give the K and the distortion of this camera in this mode, calibrate it (saunet calibrate with a "
            "board, or video=DRIVE without), or let the training estimate it with camera: unknown"
        )
        yield Finding("error", text, fix)
    if not (0.35 < (cx + 0.5) / width < 0.65 and 0.2 < (cy + 0.5) / height < 0.8):
        text = f"{told}: the center is far from the middle of the image"
        yield Finding("warning", text, "is K that of uncropped or differently sized images?")


def _neighbors(survey: Survey) -> Iterator[Finding]:
    for split, reasons in survey.left_out.items():
        absent, listed = survey.absent[split]
        total, missing = survey.windows[split] + sum(reasons.values()), reasons.get(ABSENT, 0)
        if absent:
            text = f"{absent} of {listed} recordings of the {split} split are missing"
            fix = "add them, or choose a split of the existing ones, such as data.split=all for KITTI"
            yield Finding("warning", f"{text}, with {missing} of its {total} frames", fix)
        total -= missing
        for reason, count in reasons.items():
            if reason in ("without neighbor", "missing") and count > max(10, 0.2 * total):
                fix = "check that frame numbers are consecutive and that no frames were dropped"
                yield Finding("warning", f"{count} of {total} {split} frames are left out, {reason}", fix)


def _leak(survey: Survey) -> Iterator[Finding]:
    if survey.shared_frames:
        text = f"{survey.shared_frames} frames are used by both training and validation samples"
        fix = "hold out whole drives or clips (data.val_drives, data.val_clips) for an honest validation"
        yield Finding("warning", text, fix)
    elif survey.overlap:
        yield Finding("note", survey.overlap)


def _parallax(survey: Survey) -> Iterator[Finding]:
    flows = np.array([frame.flow for frame in survey.compared() if (frame.flow or 0) >= MIN_FLOW])
    if not flows.size:
        if survey.compared():
            yield Finding(
                "error", "nothing moves in any frame that was read", "check whether this is a recording of a drive"
            )
        return
    low, middle, high = np.quantile(flows, [0.05, 0.5, 0.95])
    rates = sorted({round(camera.fps, 2) for camera in survey.cameras if camera.fps})
    rate = f" (recorded at {', '.join(map(str, rates))} frames per second)" if rates else ""
    yield Finding(
        "note",
        f"motion between frames {survey.step} apart: median {middle:.1f} px at 320 px width, 5 to 95 % of moving "
        f"frames: {low:.1f} to {high:.1f}{rate}",
    )
    if middle < 1.5:
        wider = max(2, round(survey.step * 4 / middle))
        text = f"the picture moves by {middle:.1f} px per step, too little to tell depths apart"
        yield Finding("warning", text, f"use data.offsets=[-{wider},{wider}] or a lower frame rate")
    elif middle > 25:
        text = f"the picture moves by {middle:.0f} px per step, so neighbors hardly overlap"
        yield Finding("warning", text, "use more frames per second or smaller data.offsets")


def _times(survey: Survey) -> Iterator[Finding]:
    lines = survey.timelines
    gaps = [(end - start, start, line.drive) for line in lines for start, end in line.gaps]
    if gaps:
        longest, start, drive = max(gaps)
        count = f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} in time"
        where = f"in {len({drive for *_, drive in gaps})} of {len(lines)} recordings"
        text = f"{count} {where}, the longest {longest:.2f} s long, after {start:.2f} s of '{drive}'"
        yield Finding("note", text, "no sample spans a gap")
    stamps = [line.drive for line in lines if (np.diff(line.times) <= 0).any()]
    if stamps:
        text = f"time stamps repeat or go back in {len(stamps)} of {len(lines)} recordings, such as '{stamps[0]}'"
        yield Finding("warning", text, "speeds there are wrong: repair the stamps, or leave the frames out")
    uneven = [(line, rates) for line in lines if (rates := line.rates) and rates[2] > _UNEVEN * rates[0]]
    if uneven:
        line, (low, _, high) = uneven[0]
        text = f"the frame rate varies in {len(uneven)} of {len(lines)} recordings, such as '{line.drive}'"
        fix = "data.fps (video) uses frames at equal time steps"
        yield Finding("note", f"{text} ({low:.3g} to {high:.3g} frames per second)", fix)
    unknown = [line.drive for line in lines if not line.times.size]
    if unknown and len(unknown) < len(lines):
        text = f"frames have no times in {len(unknown)} of {len(lines)} recordings, such as '{unknown[0]}'"
        yield Finding("note", text, "give fps in camera.yaml")


def _cuts(survey: Survey) -> Iterator[Finding]:
    split = max((reasons.get("split at cuts", 0) for reasons in survey.left_out.values()), default=0)
    if split:
        text = f"positions where the picture changes completely (cuts, loops, recordings in one folder): {split}"
        yield Finding("note", text, "clips are split there, so no sample spans a cut")
    usual = float(np.median([frame.change or 0 for frame in survey.compared()] or [0]))
    apart = [frame for frame in survey.compared() if (frame.change or 0) >= max(CUT, PEAK * usual)]
    if apart:
        text = (
            f"frames that hardly resemble their neighbor: {len(apart)}, such as {apart[0].index} of '{apart[0].drive}'"
        )
        fix = (
            "if there is a cut, or recordings share a folder, give each its own folder; a fast turn can look like "
            "this too"
        )
        yield Finding("warning", text, fix)


def _doubled(survey: Survey) -> Iterator[Finding]:
    compared = survey.compared()
    doubled = sum(map(is_doubled, compared))
    if doubled > 0.02 * len(compared):
        text = f"{doubled} of {len(compared)} frames are identical to their neighbor"
        fix = "the video's frame rate was raised: use the original, or data=video, which drops doubled frames"
        yield Finding("warning", text, fix)


def _static(survey: Survey) -> Iterator[Finding]:
    compared = survey.compared()
    still = sum((frame.flow or 0) < MIN_FLOW for frame in compared)
    if still > 0.05 * len(compared):
        text = f"{still} of {len(compared)} frames show no motion, so nothing can be learned from them"
        yield Finding("warning", text, f"{_USE_MANIFEST}, or data.static=flow (kitti) or drop (video)")


def band_profile(survey: Survey) -> np.ndarray | None:
    """Return each band's motion relative to the whole image's, from top to bottom; None with few frames."""
    rows = [f.bands / f.flow for f in survey.compared() if f.bands is not None and f.flow is not None and f.flow > 1]
    return np.median(rows, axis=0) if len(rows) >= 5 else None


def _bonnet(survey: Survey) -> Iterator[Finding]:
    profile = band_profile(survey)
    if profile is None or (profile < _STILL_BAND).all():
        return
    share = int(np.argmin(profile[::-1] < _STILL_BAND)) / BANDS
    if share:
        text = f"the lowest {share:.0%} of the picture does not move: the car's hood, a dashboard or an overlay"
        yield Finding("warning", text, f"cut it off with data.crop=[0,{share:.2f},0,0] (video), or crop in camera.yaml")


def _light(survey: Survey) -> Iterator[Finding]:
    frames = survey.readable()
    if not frames:
        return
    light = np.array([frame.brightness for frame in frames])
    flat = sum(frame.contrast < FLAT for frame in frames)
    yield Finding("note", f"brightness {np.median(light):.2f} (median), {light.min():.2f} to {light.max():.2f}")
    for count, what in (
        (int((light < DARK).sum()), "are almost black"),
        (int((light > BRIGHT).sum()), "are almost white"),
        (flat, "have no contrast"),
    ):
        if count:
            yield Finding("warning", f"{count} frames {what}", _USE_MANIFEST)


def _truth(survey: Survey) -> Iterator[Finding]:
    truths = survey.truths
    if not survey.truth_wanted:
        return
    have, total = survey.compared_views or (0, 0)
    counted = f", which {have} of the {total} test frames have" if survey.compared_views else ""
    if not truths:
        how = "" if survey.protocol == "campus" else " with protocols=[campus]"
        text = f"no ground-truth depth: training needs none; evaluation{how} compares views of neighboring frames"
        yield Finding("note", text + counted)
        return
    if survey.views_too:
        yield Finding("note", f"evaluation also compares views of neighboring frames{counted}")
    known = float(np.mean([truth.known for truth in truths]))
    low, high = min(truth.low for truth in truths), max(truth.high for truth in truths)
    middle = float(np.median([truth.middle for truth in truths]))
    text = f"ground truth in {len(truths)} of {survey.truth_wanted} checked frames: {known:.1%} of the pixels"
    yield Finding("note", f"{text}, {low:.1f} to {high:.1f} m, median {middle:.1f} m")
    if high > 1000 or not 1 <= middle <= 100:
        text = f"depths have a median of {middle:.1f} m and reach {high:.0f} m"
        yield Finding("warning", text, "are they in meters?")


def _distances(survey: Survey) -> Iterator[Finding]:
    yield from (Finding("warning", problem) for problem in dict.fromkeys(survey.speed_problems))
    known = [facts for facts in survey.speeds if facts.known]
    if not known:
        return
    speeds = [facts.speed for facts in known if facts.speed is not None]
    usual = float(np.median(speeds)) if speeds else 0.0
    typical = f" (typically {usual:.1f} m/s, {3.6 * usual:.0f} km/h)" if speeds else ""
    text = f"the distance traveled is known in {len(known)} of {len(survey.speeds)} recordings{typical}"
    trains = "+objective.extra.velocity.weight=0.1 trains"
    if not survey.with_speed:
        trains = "data.with_speed=true with +objective.extra.velocity.weight=0.1 trains"
    yield Finding("note", text, f"{trains} depth in meters; scale.method=speed measures the factor afterwards")
    partly = [facts for facts in known if facts.known < 0.995]
    if partly:
        least = min(partly, key=lambda facts: facts.known)
        text = f"in {len(partly)} of them only partly, such as {least.known:.0%} of the steps of '{least.drive}'"
        yield Finding("note", f"the distance traveled is known {text}", "the rest counts as unknown")


def _speed(survey: Survey) -> Iterator[Finding]:
    frames = survey.readable()
    seconds = float(np.median([frame.seconds for frame in frames])) if frames else 0.0
    if seconds < 2e-5:  # no files, or kept in memory
        return
    sized = [frame for frame in frames if frame.file_bytes]
    rate = sum(f.file_bytes or 0 for f in sized) / max(1e-9, sum(f.seconds for f in sized)) / 1e6
    disk = f", {rate:.0f} MB/s" if sized else ""
    text = f"reading and decoding takes {1000 * seconds:.1f} ms per image{disk}: {1 / seconds:.0f}/s per core"
    yield Finding("note", text)
    if seconds > 0.05:
        cache = "make a cache of small images once (saunet prepare cache), " if survey.cacheable else ""
        step = f"a training step of {survey.samples} samples needs {survey.samples * survey.images} images"
        text = f"one core reads {1 / seconds:.0f} images per second; {step}"
        yield Finding("warning", text, f"{cache}use more data.workers or a faster disk")


def manifest_of(survey: Survey, findings: Sequence[Finding], path: str | Path) -> Manifest:
    """Return the manifest for ``data.manifest=``: each frame that was read and is useless, under its first reason."""
    leave_out: dict[str, dict[str, list[int]]] = {}
    for frame in survey.frames:
        reason = _reason(frame)
        if reason and frame.drive in survey.numbering:
            leave_out.setdefault(frame.drive, {}).setdefault(reason, []).append(frame.index)
    facts: dict[str, Any] = {
        "read": f"{survey.judged} of {survey.known} frames read; only these were checked",
        "splits": {
            split: {"samples": count, "left_out": survey.left_out[split], "sha256": survey.fingerprints[split]}
            for split, count in survey.windows.items()
        },
        "findings": [{"level": each.level, "text": each.text, "fix": each.fix} for each in findings],
    }
    numbering = {drive: survey.numbering[drive] for drive in leave_out}
    return Manifest(leave_out, numbering, facts, Path(path), survey.test_only & leave_out.keys())


def _reason(frame: FrameFacts) -> str | None:
    reasons = {
        UNREADABLE: frame.problem is not None,
        "dark": frame.brightness < DARK,
        "bright": frame.brightness > BRIGHT,
        "flat": frame.contrast < FLAT,
        "doubled": is_doubled(frame),
        "static": frame.flow is not None and frame.flow < MIN_FLOW,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)

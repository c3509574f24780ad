"""The app's page, and what happens when a file is dropped there."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saunet.data.video.camera import read_camera
from saunet.errors import DataError, SaunetError, usable_device
from saunet.io.colormaps import COLORMAPS
from saunet.io.display import iframe
from saunet.io.images import IMAGE_SUFFIXES, image_size
from saunet.io.video import VIDEO_SUFFIXES, VideoReader
from saunet.prediction.page import depth_page
from saunet.prediction.prediction import load
from saunet.prediction.tool import PredictOptions, predict
from saunet.scale.options import ScaleOptions

if TYPE_CHECKING:
    from saunet.tools.app.tool import AppOptions

MAX_PIXELS = 40_000_000
"""Most pixels of a picture or a frame; larger ones would fill the memory."""
_EMBEDDED = 30_000_000
"""Largest page of points to show, in bytes; a larger one is only offered as a file."""
_VIEW = 81.5
"""Horizontal degrees assumed for an unknown camera: those of the camera that ``street`` was trained for."""

LOOK = """
footer { display: none !important; }
.gradio-container { max-width: 1500px !important; }
.dark .download-link { color: #b4bcff !important; }
#hint, .or { color: var(--body-text-color-subdued) !important; }
:focus-visible { outline: 2px solid #4c8dff !important; outline-offset: 1px; }
#depth { container-type: inline-size; }
/* Below 680px the two pictures are one above the other. */
#depth iframe {
  --more: clamp(0px, (680px - 100cqw) * 99, 150cqw * var(--ratio) + 60px);
  height: calc(50cqw * var(--ratio) + 110px + var(--more)) !important;
}
"""
SCRIPT = """<script>
// Gradio leaves some of its own parts without a name that a screen reader could say.
new MutationObserver(() => {
  document.documentElement.lang ||= "en";
  for (const [part, name] of [["input[type=file]", "choose a file"], ["button.center", "drop a file here, or press to choose one"]])
    for (const each of document.querySelectorAll(part)) {
      const label = each.closest(".block")?.querySelector("[data-testid=block-label]")?.textContent.trim();
      each.ariaLabel = label ? label + ": " + name : name;
    }
}).observe(document.documentElement, { childList: true, subtree: true });
</script>"""  # noqa: E501


def THEME() -> Any:  # noqa: N802
    """Return a theme with the machine's own fonts: Gradio's would be downloaded."""
    import gradio

    theme = gradio.themes.Base(
        primary_hue="indigo", font=("system-ui", "sans-serif"), font_mono=("ui-monospace", "monospace")
    )
    quiet, quiet_dark = "*neutral_600", "*neutral_300"  # Gradio's own colors are too pale to read
    return theme.set(
        body_text_color_subdued=quiet,
        body_text_color_subdued_dark=quiet_dark,
        block_info_text_color=quiet,
        block_info_text_color_dark=quiet_dark,
        button_primary_background_fill="*primary_600",
        button_primary_background_fill_dark="*primary_600",
        button_primary_background_fill_hover="*primary_700",
        button_primary_background_fill_hover_dark="*primary_700",
    )


def build(options: AppOptions, folder: Path) -> Any:
    """Return the page; results are written to the folder."""
    import gradio

    suffixes = sorted(IMAGE_SUFFIXES | VIDEO_SUFFIXES)
    with gradio.Blocks(title="saunet", analytics_enabled=False, fill_width=True) as page:
        gradio.Markdown("# Depth from one camera\nDrop a picture or a video; everything stays on this machine.")
        with gradio.Row():
            with gradio.Column(scale=1, min_width=300):
                dropped = gradio.File(label="Picture or video", file_types=suffixes, height=150)
                models = options.models()
                model = gradio.Dropdown(models, value=models[0], label="Model")
                colormap = gradio.Dropdown(list(COLORMAPS), value="magma", label="Colors")
                with gradio.Accordion("Camera: for points and meters", open=True):
                    view = gradio.Slider(
                        20, 150, _VIEW, step=0.5, label="Field of view, degrees", info="horizontal; a file overrides it"
                    )
                    camera = gradio.File(label="camera.yaml", file_types=[".yaml", ".yml"], height=140)
                    height = gradio.Number(
                        0, label="Camera height, meters", info="above the road, for metric depth; 0: unknown", minimum=0
                    )
                again = gradio.Button("Predict again", variant="primary")
            with gradio.Column(scale=3, min_width=480):
                words = "The depth appears here: its colors, and its value under the cursor."
                hint = gradio.Markdown(words, elem_id="hint")
                depth = gradio.HTML(visible=False, elem_id="depth")
                video = gradio.Video(visible=False, label="Image and disparity", interactive=False)
                points = gradio.HTML(visible=False)
                files = gradio.File(visible=False, label="Downloads", file_count="multiple", interactive=False)

        def run(path: str | None, *settings: Any) -> list[Any]:
            if path is None:
                return [gradio.update(visible=True), *[gradio.update(visible=False, value=None)] * 4]
            try:
                return list(answer(options, folder, Path(path), *settings))
            except SaunetError as error:
                raise gradio.Error(str(error), duration=None, print_exception=False) from error

        given, shown = [dropped, model, colormap, view, camera, height], [hint, depth, video, points, files]
        for event in (dropped.change, again.click, model.change, colormap.change):
            event(run, given, shown, api_visibility="private", concurrency_limit=1, show_progress="minimal")
    return page


def answer(
    options: AppOptions,
    folder: Path,
    source: Path,
    model: str,
    colormap: str,
    view: float | int,
    camera: str | None,
    height: float | int | None,
) -> tuple[Any, ...]:
    """Predict one file, and return the new content of each part of the page."""
    import gradio

    is_video = source.suffix.lower() in VIDEO_SUFFIXES
    size = _video_size(source) if is_video else image_size(source)
    if size[0] * size[1] > MAX_PIXELS:
        raise DataError(
            f"{source.name} has {size[1]}x{size[0]} pixels (width x height); at most {MAX_PIXELS:,} are allowed "
            "here: reduce it, or use saunet predict"
        )
    made = Path(tempfile.mkdtemp(prefix="result-", dir=folder))
    lens = read_camera(camera) if camera else None
    scale = ScaleOptions()
    if height or (lens and lens.camera_height):
        scale = ScaleOptions(method="camera_height", camera_height=float(height) if height else None)
    predictor = load(model, device=str(usable_device(options.device)))
    result = predict(
        PredictOptions(
            checkpoint=model,
            input=str(source),
            output=made,
            outputs=["mp4", "html"] if is_video else ["color", "png16", "npy", "ply", "html"],
            camera=[float(view)] if lens is None else camera if lens.is_straight else None,
            undistort=camera if lens and not lens.is_straight else None,
            scale=scale,
            colormap=colormap,
            max_frames=options.max_frames,
            device=options.device,
        ),
        predictor,
    )
    if is_video:
        with contextlib.closing(VideoReader(source)) as reader:
            first = predictor.predict(next(iter(reader)), f"{source.name}, first frame")
    else:
        first = predictor.predict(source, source.name)
    pages = [path for path in result.clips if path.suffix == ".html"]
    small = [path for path in pages if path.stat().st_size <= _EMBEDDED]
    movie = next((path for path in result.clips if path.suffix == ".mp4"), None)
    text = depth_page(first, colormap)
    (made / "depth.html").write_text(text, encoding="utf-8")
    shown = iframe(text, "depth under the cursor", 480)
    cloud = iframe(small[0].read_text(encoding="utf-8"), "points in space: drag to orbit", 480) if small else ""
    taken = [*result.written, *result.clips, made / "depth.html"]
    return (
        gradio.update(visible=bool(result.failures), value="; ".join(result.failures)),
        gradio.update(visible=True, value=f'<div style="--ratio: {size[0] / size[1]:.4f}">{shown}</div>'),
        gradio.update(visible=movie is not None, value=movie and str(movie)),
        gradio.update(visible=bool(cloud), value=cloud),
        gradio.update(visible=True, value=[str(path) for path in taken]),
    )


def _video_size(source: Path) -> tuple[int, int]:
    with contextlib.closing(VideoReader(source)) as reader:
        return reader.height, reader.width

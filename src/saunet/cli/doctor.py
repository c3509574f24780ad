"""``saunet-doctor``: look at a data set before hours of training; findings, a picture sheet and a manifest."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run
from saunet.errors import one_of, positive


def doctor(cfg: DictConfig) -> None:
    """Look, print what was found with what to do about it, and write ``doctor.png`` and ``manifest.json``."""
    from hydra.core.hydra_config import HydraConfig

    from saunet.data.manifest import write_manifest
    from saunet.io.images import write_image
    from saunet.io.progress import bar
    from saunet.registry import instantiate
    from saunet.tools.doctor import diagnose, draw_sheet, manifest_of, survey
    from saunet.tools.doctor.survey import SPLITS

    for split in cfg.splits:
        one_of("splits", split, SPLITS)
    positive("frames", cfg.frames, allow_zero=True)
    data = instantiate(config.plain(cfg.data))
    with bar() as shown:
        task = shown.add_task("reading frames", total=None)
        found = survey(
            data, list(cfg.splits), cfg.frames, lambda done, total: shown.update(task, completed=done, total=total)
        )
    findings = diagnose(found)
    folder = Path(cfg.output_dir)
    name = HydraConfig.get().runtime.choices["data"]
    place = f" at {data.root}" if data.root else ""
    manifest = manifest_of(found, findings, folder / "manifest.json")
    write_manifest(manifest.path, manifest)
    write_image(folder / "doctor.png", draw_sheet(found, findings, f"saunet-doctor: {name}{place}"))
    for finding in findings:
        print(finding)
    left_out = sum(len(numbers) for reasons in manifest.leave_out.values() for numbers in reasons.values())
    print(f"pictures: {folder / 'doctor.png'}")
    judged = "all" if found.judged == found.known else f"{found.judged} of {found.known}; frames=0 judges all"
    if found.judged:
        print(f"manifest: {manifest.path} names {left_out} frames to leave out (judged: {judged})")
        print(f"train with data.manifest={manifest.path}")
    if any(finding.level == "error" for finding in findings):
        raise SystemExit(1)


def main() -> None:
    """Entry point of ``saunet-doctor``."""
    run("doctor", doctor)


if __name__ == "__main__":
    main()

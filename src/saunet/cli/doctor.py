"""``saunet-doctor``: look at a data set before hours of training; findings, a picture sheet and a manifest."""

from __future__ import annotations

from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run


def doctor(cfg: DictConfig) -> None:
    """Look, and print what was found with what to do about it; an error among it is exit code 1."""
    from saunet.registry import Spec
    from saunet.tools.doctor.tool import DoctorOptions, doctor

    options = config.plain(cfg)
    diagnosis = doctor(DoctorOptions(**{**options, "data": Spec(options["data"])}))
    print(diagnosis)
    if not diagnosis.usable:
        raise SystemExit(1)


def main() -> None:
    """Entry point of ``saunet-doctor``."""
    run("doctor", doctor)


if __name__ == "__main__":
    main()

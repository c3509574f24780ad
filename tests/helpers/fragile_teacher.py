"""A teacher that ends the process it runs in, once: what a lost machine looks like."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np

from saunet.tools.prepare.targets import ModelTeacher


class FragileTeacher(ModelTeacher):
    """Depth from the frame's number; dies at frame 2 unless the file ``grave`` exists."""

    def __init__(self, grave):
        super().__init__(None)
        self.grave = Path(grave)

    def made_from(self):
        return {"model": "fragile"}

    def depth(self, drive, frame):
        if frame == 2 and not self.grave.exists():
            self.grave.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return (1 + frame + drive.image(frame)[..., 0] / 16).astype(np.float32)

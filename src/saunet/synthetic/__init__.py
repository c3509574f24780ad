"""A procedurally generated driving world with exact depth, pose and intrinsics, and its export to KITTI's layouts."""

from __future__ import annotations

from saunet.synthetic.drive import SyntheticDrive
from saunet.synthetic.kitti_writer import write_odometry, write_raw

__all__ = ["SyntheticDrive", "write_odometry", "write_raw"]

"""Published splits of KITTI: number of frames and SHA-256 of their sorted names."""

from __future__ import annotations

PUBLISHED = {
    "eigen_test": (697, "1ef11653252ec9bd799a41cacd8078317437f79ca26af21ae71d8f6a2d3bec67"),
    "eigen_benchmark_test": (652, "9d9b0720dfdb92fc57f90a58953cfbb46f6e0b524fb30789e1d53e9dfc4697fd"),
    "eigen_zhou": (44234, "4089808686fc05b4db1b07a4a3dd46609a85751290b29bff436030fc8665c8b5"),
    "eigen_full": (46976, "ebff019c475d245a82d5b71dd3b4cd7759c82690dfe698f530162b7493571efd"),
}

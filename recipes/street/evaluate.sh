#!/usr/bin/env bash
# usage: evaluate.sh CHECKPOINT    Score a checkpoint on the real frames in $SAUNET_TEST_DATA/kitti_mini.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
exec python "$here/evaluate.py" "$1" "${SAUNET_TEST_DATA:-$here/../../../shared}/kitti_mini"

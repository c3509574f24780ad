#!/usr/bin/env bash
# usage: gpu.sh [OUT] [options of gpu.py]    One run on one GPU, at most ten minutes, without network; see gpu.py.
# Writes OUT/gpu.json and OUT/gpu.md (default: outputs/gpu), and ends with 1 if a part failed. PYTHON chooses the Python.
set -uo pipefail
here=$(cd "$(dirname "$0")" && pwd)
out=outputs/gpu
if [ $# -gt 0 ] && [ "${1#-}" = "$1" ]; then out=$1; shift; fi
export PYTHONPATH="$here/../src${PYTHONPATH:+:$PYTHONPATH}" HF_HUB_OFFLINE=1
export TORCHINDUCTOR_CACHE_DIR="${TORCHINDUCTOR_CACHE_DIR:-$out/compiled}"
mkdir -p "$out"
# gpu.py keeps to its own budget; this is for a driver that hangs.
exec timeout --kill-after=5 "${LIMIT:-590}" "${PYTHON:-python3}" "$here/gpu.py" --output "$out" "$@"

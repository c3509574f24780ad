#!/usr/bin/env bash
# usage: assets.sh FOLDER    Unpack the meshes and textures that render.py reads from the wheels in requirements.txt.
set -euo pipefail
out=$1
mkdir -p "$out/wheels"
pip download -q --no-deps -d "$out/wheels" metadrive-simulator==0.2.3 miniworld==2.1.0 scikit-image==0.26.0
unzip -qo "$out"/wheels/metadrive_simulator-*.whl 'metadrive/assets/models/*' 'metadrive/assets/textures/*' -d "$out"
unzip -qo "$out"/wheels/miniworld-*.whl 'miniworld/textures/*' -d "$out"
unzip -qo "$out"/wheels/scikit_image-*.whl 'skimage/data/*' -d "$out"

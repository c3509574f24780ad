"""Files read and written: images, video, camera paths, atomic files, color maps."""

"""Clips of any camera: folders of frames or videos, and one ``camera.yaml``."""

"""Registered pose networks: frames -> relative camera motion."""

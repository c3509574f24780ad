"""Registered objectives: weighted compositions of terms."""

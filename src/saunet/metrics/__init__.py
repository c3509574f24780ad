"""Depth metrics and the protocols they are computed under."""

"""From recordings to batches: what every data set shares."""

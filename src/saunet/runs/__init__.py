"""What a run folder is: written by training, read by reports."""

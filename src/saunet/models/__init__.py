"""Networks: encoders, decoders, pose networks, and the depth network that combines the first two."""

"""Networks: encoders, decoders, pose networks, and the depth network that joins the first two."""

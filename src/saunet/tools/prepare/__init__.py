"""Work done once before training: dense depth, teachers, and smaller copies of recordings."""

"""Looking at a data set before hours of training: what is there, what is wrong with it, and what to do about it."""

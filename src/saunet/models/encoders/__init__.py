"""Registered encoders: RGB in [0, 1] -> feature maps b c h/s w/s, finest first.

``features`` gives channels and stride of each; height and width must be multiples of ``size_divisor``.
"""

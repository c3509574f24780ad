"""``python -m saunet.cli.train``: the same as ``saunet train``, for torchrun."""

from saunet.cli.app import run

if __name__ == "__main__":
    import sys

    run("train", sys.argv[1:])

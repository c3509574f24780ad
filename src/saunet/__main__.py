"""``python -m saunet``: the same as the command ``saunet``."""

from saunet.cli.app import main

main()

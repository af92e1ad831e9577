"""``python -m graphslam``: the same as the console script."""

from graphslam.cli import main

main()

"""``python -m engine.cli`` is ``scenematch``."""

from engine.cli import main

main()

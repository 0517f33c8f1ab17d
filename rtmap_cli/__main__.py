"""``python -m rtmap_cli`` is ``rtmap``."""

from rtmap_cli.cli import main

main()

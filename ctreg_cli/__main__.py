"""``python -m ctreg_cli``."""

from ctreg_cli.cli.app import main

if __name__ == "__main__":
    main()

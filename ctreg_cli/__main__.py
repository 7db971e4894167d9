"""``python -m ctreg_cli``."""

import sys
from pathlib import Path

# ``python -m`` puts the working directory first on the path, and a folder of the user's called ``dl`` there would be
# imported by a codec in place of the real module; only a source checkout needs that entry
if not Path("ctreg_cli").is_dir():
    sys.path[:] = [entry for entry in sys.path if entry and Path(entry) != Path.cwd()]

from ctreg_cli.cli.app import main

if __name__ == "__main__":
    main()

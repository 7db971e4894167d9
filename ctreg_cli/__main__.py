"""``python -m ctreg_cli``."""

import sys
from pathlib import Path

# ``python -m`` puts the working directory first on the path; a folder of the user's called ``dl`` or ``test`` there would
# be imported by a codec in place of the real module
sys.path[:] = [entry for entry in sys.path if entry and Path(entry) != Path.cwd() or (Path(entry or ".") / "ctreg_cli").is_dir()]

from ctreg_cli.cli.app import main  # noqa: E402

if __name__ == "__main__":
    main()

"""Commands in processes of their own, which run the code of this checkout."""

import os
import sys

#: `vlc-rx`, and the environment that finds it.
COMMAND = [sys.executable, "-m", "rxcli.cli.main"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}

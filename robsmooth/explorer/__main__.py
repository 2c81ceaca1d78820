"""Open the explorer in a browser tab, without its code: python -m robsmooth.explorer."""

import subprocess
import sys
import tempfile
from pathlib import Path

from nbformat import v4, write

cells = [
    v4.new_markdown_cell("# Which smoother, and does robustness pay?"),
    v4.new_code_cell("from robsmooth.explorer import Explorer\n\nExplorer().widget"),
]
with tempfile.TemporaryDirectory() as folder:
    page = Path(folder) / "explore.ipynb"
    write(v4.new_notebook(cells=cells), page)
    command = [sys.executable, "-m", "voila", str(page), "--token", *sys.argv[1:]]
    try:
        sys.exit(subprocess.run(command).returncode)
    except KeyboardInterrupt:  # the way to end it
        sys.exit(0)

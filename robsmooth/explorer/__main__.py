"""Open the explorer in a browser tab, without its code: python -m robsmooth.explorer."""

import sys
import tempfile
from pathlib import Path

from nbformat import v4, write
from voila.app import Voila

title = v4.new_markdown_cell("# Which smoother, and does robustness pay?")
explorer = v4.new_code_cell("from robsmooth.explorer import Explorer\n\nExplorer().widget")
with tempfile.TemporaryDirectory() as folder:
    page = Path(folder) / "explore.ipynb"
    write(v4.new_notebook(cells=[title, explorer]), page)
    Voila.launch_instance([str(page), "--token", *sys.argv[1:]])

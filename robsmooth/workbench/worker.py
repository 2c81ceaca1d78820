"""The life of one child process: run one notebook by papermill, in a kernel of this environment.

Started by `execution.Execution` as a script, with the job as JSON on its standard input.
"""

import json
import sys

import papermill
from papermill.exceptions import PapermillExecutionError


def main() -> None:
    """Run the notebook of the job on standard input.

    Where that fails for another reason than an error in a cell, say why on standard output.
    """
    job = json.load(sys.stdin)
    try:
        papermill.execute_notebook(
            _literal(job["notebook"]),
            _literal(job["executed"]),
            job["parameters"],
            kernel_name="python3",
            language="python",
            cwd=job["folder"],
            progress_bar=False,
            execution_timeout=job["cell_limit"],
            # Else ipykernel warns at each start that it talks to us over (local) TCP.
            extra_arguments=["--log-level=ERROR"],
        )
    except PapermillExecutionError:
        sys.exit(1)
    except Exception as error:
        print(f"{type(error).__name__}: {error}")
        sys.exit(1)


def _literal(path: str) -> str:
    """`path` with the braces that papermill would take for a template's escaped."""
    return path.replace("{", "{{").replace("}", "}}")


if __name__ == "__main__":
    main()

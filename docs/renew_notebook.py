"""Run docs/tour.ipynb and keep it with its outputs, after a change of it or of what it shows (half a minute).

    python docs/renew_notebook.py

TOUR_TRAINING_STEPS=4096 in the environment makes the training short.
"""

from pathlib import Path
from typing import Any

from sd_friction_env.storage import atomic_file

NOTEBOOK = Path(__file__).with_name("tour.ipynb")


def read(path: Path = NOTEBOOK) -> Any:
    """Return a notebook as it is kept."""
    import nbformat

    return nbformat.read(path, as_version=4)


def executed(path: Path = NOTEBOOK) -> Any:
    """Return a notebook as it is after all of its cells have run.

    Raises:
        nbclient.exceptions.CellExecutionError: if one fails.
    """
    from nbclient import NotebookClient

    notebook = read(path)
    NotebookClient(notebook, timeout=600, record_timing=False, resources={"metadata": {"path": path.parent}}).execute()
    return notebook


def main() -> None:
    """Renew the notebook, whole or not at all."""
    import nbformat

    notebook = executed()
    with atomic_file(NOTEBOOK) as file:
        nbformat.write(notebook, file)


if __name__ == "__main__":
    main()

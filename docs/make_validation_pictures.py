"""Draw the pictures of docs/evidence/validation.md again from docs/data/validation.json, without measuring.

python docs/make_validation_pictures.py
"""

from __future__ import annotations

from pathlib import Path

from orchestrator.extra_commands import physics_command

DOCS = Path(__file__).resolve().parent


def main() -> None:
    """Draw what has curves; a case that was measured before they were kept is left as it is."""
    for name, record in physics_command.kept_records(DOCS).items():
        figure = physics_command.figure_of(record)
        if figure is None:
            print(f"{name}: no curves are kept")
        elif record["image"] is not None:
            print(physics_command.draw(figure, DOCS / physics_command.IMAGES / record["image"]))


if __name__ == "__main__":
    main()

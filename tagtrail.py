"""The `tagtrail` command: checks that our packages are ours, then hands over to `diagrams.cli`.

Our packages have general names (`systems`, `plants`, `diagrams`), and PyPI has strangers of the
same name. This module is the one whose name nobody else has, so it can look before it imports.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

_PACKAGES = ("systems", "plants", "diagrams")


def stranger() -> str | None:
    """Returns a line that names a package which hides one of ours, or None when all are ours."""
    home = Path(__file__).resolve().parent
    for name in _PACKAGES:
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            return f"tagtrail: the package {name!r} cannot be imported: {error}"
        if getattr(module, "__distribution__", None) != "tagtrail":
            where = module.__file__ or next(iter(module.__path__), "an unknown place")
            return (
                f"tagtrail: the package {name!r} found at {where} is not Tagtrail's (expected in "
                f"{home}): install tagtrail into an environment of its own"
            )
    return None


def main() -> int:
    """Runs the command line; returns the exit status (see `diagrams.cli`)."""
    problem = stranger()
    if problem:
        print(problem, file=sys.stderr)
        return 2
    from diagrams import cli  # only now is it known to be ours

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())

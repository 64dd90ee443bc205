"""The `polypod` command."""

import sys
from importlib.util import find_spec

_TRAIN_EXTRA = {"rich": "rich", "rsl_rl": "rsl-rl-lib", "tensordict": "tensordict", "torch": "torch", "tyro": "tyro"}


def main() -> int:
    """Runs the command line and returns its exit code: 0, 2 for bad input, 1 for internal errors, 130 after Ctrl-C."""
    missing = [package for module, package in _TRAIN_EXTRA.items() if find_spec(module) is None]
    if missing:
        remedy = "install the train extra: pip install 'polypod[train]'"
        print(f"polypod: the command line needs {', '.join(missing)}; {remedy}", file=sys.stderr)
        return 2
    from polypod import cli

    return cli.main(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())

"""The type of what a command adds its parser to."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

# Generic to type checkers alone: at run time argparse's class takes no parameter.
if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Commands = argparse._SubParsersAction

"""Make the packages of the repository and this folder's emulated board importable."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
for folder in (str(HERE), str(HERE.parents[1])):
    if folder not in sys.path:
        sys.path.append(folder)  # last: no module of another test folder is hidden

"""For workers of a cluster: no file of the checkout is there to be opened.

Python runs this at its start where the folder is on PYTHONPATH.
"""

import os
import sys

ELSEWHERE = tuple(os.environ["ELSEWHERE"].split(os.pathsep))


def refuse(event, args):
    if event == "open" and isinstance(args[0], str):
        path = os.path.abspath(args[0])  # noqa: PTH100 (pathlib may not be imported yet)
        if path.startswith(ELSEWHERE):
            raise FileNotFoundError(2, "It is on another machine", path)


sys.addaudithook(refuse)

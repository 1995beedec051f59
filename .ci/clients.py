"""Run the code of one library on the page of libraries: `python clients.py LIBRARY`."""

import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parent.parent / "benchmarks/examples/clients.md"

name = sys.argv[1]
page = PAGE.read_text(encoding="utf-8")
# The heading of a library is "## TITLE (`NAME` VERSION)".
_, section = re.split(rf"^## .*\(`{name}` .*\)$", page, flags=re.MULTILINE)
section, *_ = section.split("\n## ")
for _, *words in map(str.split, re.findall(r"^    (python -m .*)", section, re.MULTILINE)):
    subprocess.run([sys.executable, *words], check=True)
for code in re.findall(r"```python\n(.*?)```", section, re.DOTALL):
    exec(code, {})
print(f"{name}: the code of the page runs")

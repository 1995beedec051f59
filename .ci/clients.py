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
commands = re.findall(r"^    python (-m .*)", section, re.MULTILINE)
if name == "rl_zoo3":  # the first line of a file is the command of the file
    for file in PAGE.parent.glob("rl_zoo/*.yml"):
        line = file.read_text(encoding="utf-8").splitlines()[0]
        line = line.removeprefix("# python ").replace(file.name, str(file))
        commands.append(f"{line} -n 9999")
for command in commands:
    subprocess.run([sys.executable, *command.split()], check=True)
for code in re.findall(r"```python\n(.*?)```", section, re.DOTALL):
    exec(code, {})
print(f"{name}: the code of the page runs")

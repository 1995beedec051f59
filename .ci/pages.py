"""Add the repository's pages, pictures and tables to the site, and its source files as pages.

MkDocs expects all pages in one folder, but those of this project are beside the code.
"""

import re
import subprocess
from pathlib import Path

import markdown
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

from mptc_gym import evaluation
from mptc_gym.plant.parameters import argument_table

ROOT = Path(__file__).parent.parent
CONTRIBUTING = ".github/CONTRIBUTING.md"
SHOWN = {".csv", ".gif", ".ipynb", ".json", ".md", ".png", ".txt", ".yml"}
TABLE = markdown.markdown(argument_table(), extensions=["tables"])
CONSTANTS = re.compile(r'<span class="n">(SEED|EPISODES)</span>')  # in signatures
PICTURE = re.compile(r'(<img [^>]*src="([^"]+)"[^>]*>)')
TO_SOURCE = re.compile(r"(\]\((?!https?:)[^)#]+\.py)\)")


@event_priority(100)  # before plugins that look for their own files, such as notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the tracked pages and the files that they show, and a page for each source file."""
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True)
    for name in tracked.splitlines():
        path = ROOT / name
        if (name.startswith((".", "tests")) and name != CONTRIBUTING) or not path.exists():
            continue
        if path.suffix in SHOWN or name == "LICENSE":
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
        elif path.suffix == ".py":
            code = path.read_text(encoding="utf-8")
            head = f"---\nsearch: {{exclude: true}}\nhide: [toc]\n---\n# {name}"
            page = f"{head}\n\n~~~~python\n{code}~~~~\n"
            files.append(File.generated(config, f"{name}.md", content=page))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Point links to source files at their pages."""
    return TO_SOURCE.sub(r"\1.md)", markdown)


def on_page_content(html: str, **_: object) -> str:
    """Link each picture to its full-size version, for small screens; show values of constants.

    Remove the `::` before literal blocks in docstrings, which Markdown does not know, and put
    in the table of arguments, which the environment's docstring gets when it is imported.
    """
    html = html.replace("<p>::</p>\n", "").replace("<p><arguments></p>", TABLE)
    html = CONSTANTS.sub(lambda name: f"{getattr(evaluation, name[1]):_}", html)
    html = html.replace('href="README.md"', 'href="../"')  # in the notebook
    return PICTURE.sub(r'<a href="\2">\1</a>', html)

"""Add the repository's pages, pictures and tables to the site, and its source files as pages.

MkDocs expects all pages in one folder, but the pages of this project are beside the code.
"""

import re
import subprocess
from pathlib import Path

import markdown
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

from mptc_gym.plant.parameters import argument_table

ROOT = Path(__file__).parent.parent
CONTRIBUTING = ".github/CONTRIBUTING.md"
# Suffixes of the files that the site shows or offers as they are.
SHOWN = {".csv", ".ipynb", ".json", ".md", ".png", ".txt", ".yml"}
ARGUMENTS = markdown.markdown(argument_table(), extensions=["tables"])  # a table in HTML
# The end of a relative link to a source file, in Markdown.
LINK_TO_SOURCE = re.compile(r"(\]\((?!https?:)[^)#]+\.py)\)")


@event_priority(100)  # before plugins that look for their own files, such as notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the checkout, the files that they show, and a page for each source file.

    Only files in git are added. `files` are the files of the site, and are also returned.
    """
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True)
    for name in tracked.splitlines():
        path = ROOT / name
        if name.startswith((".", "tests")) and name != CONTRIBUTING:
            continue
        if not path.exists():  # a file that was removed after the latest commit
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
    """Return a page in Markdown, with links to the pages of source files."""
    return LINK_TO_SOURCE.sub(r"\1.md)", markdown)


def on_page_content(html: str, **_: object) -> str:
    """Return a page in HTML with what Markdown cannot say, such as the table of arguments."""
    html = html.replace("<p>::</p>\n", "")  # before literal blocks in docstrings
    # The environment's docstring gets the table of its arguments when it is imported.
    html = html.replace("<p><arguments></p>", ARGUMENTS)
    # In the notebook.
    return html.replace('href="train_your_own.md"', 'href="../train_your_own/"')

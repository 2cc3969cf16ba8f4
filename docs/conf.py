"""
The documentation site, built by ``make docs``. Its sources are the Markdown files that are also read on GitHub. The source
folder is the repository, so that a link between them is the same here and there.
"""

import configparser
import hashlib
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "extensions"))

_metadata = configparser.ConfigParser()
_metadata.read(ROOT / "setup.cfg")

project = "sb3_ddiffpg"
author = _metadata["metadata"]["author"]
release = version = _metadata["metadata"]["version"]

extensions = ["myst_nb", "public_api", "mathml"]
root_doc = "docs/index"
include_patterns = ["docs/**", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "results/README.md"]
# Folders with many files are not even looked into
exclude_patterns = [
    ".*",
    "build",
    "dist",
    "runs",
    "logs",
    "videos",
    "sb3_ddiffpg*",
    "tests",
    "results/*/*",
    "benchmarks",
    "findings",
]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}

myst_enable_extensions = ["dollarmath", "deflist", "attrs_inline"]
# As GitHub makes them
myst_heading_anchors = 4


def _digest() -> str:
    """Of all that cells run, but the cells themselves."""
    files = [ROOT / "constraints.txt", *(ROOT / "sb3_ddiffpg").rglob("*.py"), *(ROOT / "zoo_hyperparams").glob("*.yml")]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(files))).hexdigest()[:16]


# The tutorials are run, each in a folder of its own, and again when their cells or the package change. A cell that fails ends
# the build. `make docs TUTORIALS=off` runs none
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "tutorials" / _digest())
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # seconds for one cell: what a reader may have to wait for a whole page
nb_merge_streams = True
suppress_warnings = ["myst-nb.lexer"]  # of cells that are not run: nothing then says which language they are in

html_theme = "furo"
html_title = f"sb3_ddiffpg {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
# index.html, which leads to docs/index.html
html_extra_path = ["static/root"]
html_copy_source = False
html_show_sphinx = html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}
# The site needs no network
html_math_renderer = "mathml"

add_module_names = False
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
pygments_style = "default"
pygments_dark_style = "monokai"

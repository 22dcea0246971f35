"""The site: `make docs` builds it into out/docs, without a network."""

import re

import cfr_jax

project = "cfr_jax"
author = "The cfr_jax authors"
copyright = "the cfr_jax authors, MIT license"
version = release = cfr_jax.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

default_role = "code"  # docstrings write `names` so

html_theme = "furo"
html_title = f"cfr_jax {version}"
html_static_path = []
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
# Shapes stand in the types: `Float[Array, "n 3"]` is what a reader needs, and not its full path.
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True


def setup(app):
    app.connect("autodoc-process-docstring", bars_stay_bars)
    app.connect("source-read", list_the_other_pages)
    app.connect("source-read", list_the_public_names)


def list_the_other_pages(app, name, source):
    """A page that the index does not name is listed by it all the same."""
    if name == "index":
        named = {line.strip() for line in source[0].splitlines()} | {"index"}
        others = "\n".join(sorted(app.env.found_docs - named))
        source[0] = source[0].replace("(the other pages)", others)


def list_the_public_names(app, name, source):
    """The reference documents every name of `cfr_jax.__all__`: in that order."""
    if name == "api":
        public = [each for each in cfr_jax.__all__ if not each.startswith("__")]
        source[0] = source[0].replace("(the public names)", "\n".join(map(documented, public)))


def documented(name):
    value = getattr(cfr_jax, name)
    if isinstance(value, type) and issubclass(value, Exception):
        return f".. autoexception:: cfr_jax.{name}\n"
    if isinstance(value, type):
        return f".. autoclass:: cfr_jax.{name}\n   :members:\n"
    return f".. autofunction:: cfr_jax.{name}\n"


def bars_stay_bars(app, what, name, obj, options, lines):
    """|x| is a length in our formulas, and not a substitution; within `…` it is safe already."""
    for k, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[k] = "".join(parts)

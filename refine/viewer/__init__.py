"""A page that shows what `refine` made under a light one can move; see docs/viewer.md."""

from refine.viewer.page import build_page

__all__ = ["build_page"]

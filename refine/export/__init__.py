"""What `refine` made, in the formats of other programs; see docs/exports.md."""

from refine.export.targets import TARGETS, export_material

__all__ = ["TARGETS", "export_material"]

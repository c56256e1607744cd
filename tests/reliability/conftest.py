"""The photo and the tiny network of the end-to-end tests."""

from tests.e2e.conftest import checkpoint, photo

__all__ = ["checkpoint", "photo"]

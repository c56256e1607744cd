"""Whatever refinement is fed: finite legal maps, no exception, no photo explained worse than before."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.benchmarks.cases import Choice, draw_case
from eval.benchmarks.soak import RECIPES, check


class Drawn:
    """Chance from hypothesis, which makes what fails small."""

    def __init__(self, draw: Callable[[st.SearchStrategy[Any]], Any]) -> None:
        self.draw = draw

    def one_of(self, options: Sequence[Choice]) -> Choice:
        return self.draw(st.sampled_from(options))

    def integer(self, low: int, high: int) -> int:
        return self.draw(st.integers(low, high))

    def number(self, low: float, high: float) -> float:
        return self.draw(st.floats(low, high, allow_nan=False, width=32))


@pytest.mark.parametrize(("engine", "examples"), [("fused", 1000), ("reference", 100)])
def test_any_input_gives_a_legal_material_that_explains_its_photos_no_worse(
    engine: str, examples: int
) -> None:
    @settings(max_examples=examples)
    @given(st.data(), st.sampled_from(sorted(RECIPES)))
    def examine(data: st.DataObject, recipe: str) -> None:
        check(draw_case(Drawn(data.draw)), recipe, engine)

    examine()

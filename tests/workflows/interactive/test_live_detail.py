"""How finely the live page draws without a graphics card: coarser where drawing takes too long, finer where it would not."""

from __future__ import annotations

import pytest
from browser import CHROMIUM, opened_browser
from served_models import served

LEVELS = """((nodes, pixels, times) => {
  const detail = new naibuLive.view.detail.constructor(nodes, pixels);
  return times.map((time) => { for (let k = 0; k < 3; k += 1) detail.took(time); return [detail.level.ratio, detail.level.nodes]; });
})(%d, %d, %s)"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_the_level_of_detail_follows_the_time_that_drawing_takes() -> None:
    with served() as (address, _), opened_browser() as page:
        page.open(address)
        page.wait("document.querySelector('.stage[data-ready]') !== null && naibuLive.view.detail !== null", 60)

        def levels(nodes: int, times: list[float]) -> list[list[float | None]]:
            return list(page.value(LEVELS % (nodes, 480_000, times)))

        finest, large = [1, None], levels(50_000, [40.0, 30.0, 20.0, 12.0, 12.0])  # infinity is null in JSON
        assert [nodes for _, nodes in large] == sorted((nodes for _, nodes in large), reverse=True)
        assert [ratio for ratio, _ in large] == sorted((ratio for ratio, _ in large), reverse=True)
        assert large[0] != finest and large[-2] == large[-1] and large[-1][0] < 1  # there is a coarsest one
        small = levels(500, [40.0, 40.0, 40.0])  # nothing to leave out but pixels
        assert len({ratio for ratio, _ in small}) == 2 and small[-1][0] == 0.5
        assert levels(50_000, [40.0, 6.0, 6.0])[1:] == [large[0]] * 2  # the finer one would take too long: it stays
        assert levels(50_000, [40.0, 40.0, 0.2, 0.2, 0.2])[-1] == finest
        assert levels(50_000, [5.0, 5.0]) == [finest] * 2

"""
A result as figure, table and page
==================================

What `naibu.sense` returns draws itself: displacement, largest principal strain and stated standard deviation in the slice with most of the
object. In a notebook the result alone, as the last line of a cell, shows the page with slices that can be moved; see :doc:`/notebook`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import naibu
from naibu.io import write_volume
from naibu.validation import squeezed_ball

place = Path(tempfile.mkdtemp())
free, pressed, _, mask = squeezed_ball(seed=5)
write_volume(place / "free.mha", free)
write_volume(place / "pressed.mha", pressed)
write_volume(place / "mask.mha", free.with_values(mask.astype("uint8")))

result = naibu.sense(place / "free.mha", place / "pressed.mha", mask=place / "mask.mha")
result.plot()
plt.show()

# %%
# The table needs no other package; ``result.to_dataframe()`` gives it to pandas.
for row in result.to_records()[:7]:
    print(f"{row['quantity']}: {row['value']}")

"""Are the stated intervals right? Virtual specimens with known truth, solved on another mesh: ``interval_coverage.py [DRAWS]``.

Two gels between sticking and slipping plates, 0.15 mm noise a coordinate; prints the errors of the modulus ratio and of Poisson's
ratio, and the share of 95 % intervals that hold the truth.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.parameter_names import poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.validation.specimens.marker_phantoms import Scanner, two_gels, virtual_specimen

NOISE_MM = 0.15


def main() -> None:
    """Identify every draw and print the summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("draws", nargs="?", type=int, default=20, help="noisy scans to identify")
    draws = parser.parse_args().draws
    template, truth = two_gels(44.0)
    virtual = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=6.0))
    inside, ratio, nu, start = [], [], [], time.perf_counter()
    for seed in range(draws):
        data = virtual.scanned(seed=seed, scanner=Scanner(placing_mm=NOISE_MM, xy_step_mm=0.0, z_step_mm=0.0))
        found = calibrate(
            [data.experiment],
            known_materials=KnownMaterials({"stiff": 222.0}),
            noise=NoiseModel(NOISE_MM),
            start={young_modulus("soft"): 120.0},
        )
        model = CalibratedModel.of(found)
        values = model.parameters.values()
        names = [n for n in truth if n != young_modulus("stiff")]
        inside.append([model.interval(n)[0] <= truth[n] <= model.interval(n)[1] for n in names])
        ratio.append(values[young_modulus("soft")] / truth[young_modulus("soft")] - 1.0)
        nu.append([values[poisson_ratio(m)] - truth[poisson_ratio(m)] for m in ("soft", "stiff")])
        errors = f"ratio {100 * ratio[-1]:+.2f} %, nu {nu[-1][0]:+.4f} {nu[-1][1]:+.4f}"
        print(f"draw {seed}: {errors}, intervals hold {sum(inside[-1])}/{len(names)}, {time.perf_counter() - start:.0f} s", flush=True)
    print(f"modulus ratio: mean error {100 * np.mean(ratio):+.2f} %, RMS {100 * np.sqrt(np.mean(np.square(ratio))):.2f} %")
    print(f"Poisson's ratio: RMS error {np.sqrt(np.mean(np.square(nu))):.4f}")
    share = 100 * np.mean(inside)
    print(f"95 % intervals hold the truth in {share:.1f} % of {np.size(inside)} cases; by parameter {np.mean(inside, axis=0).round(2)}")


if __name__ == "__main__":
    main()

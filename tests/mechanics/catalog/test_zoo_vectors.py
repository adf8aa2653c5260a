"""The catalogue's mechanisms against accelerations computed elsewhere to 40 digits."""

import numpy as np
import pytest
import zoo

import mechanics
from mechanics.catalog.trailer import n_trailer

# Catalogue -> zoo, where the coordinates stand in the same order under other names.
SAME = {
    "car": "car_dynamic",
    "chaplygin_beanie": "chaplygin_beanie",
    "chaplygin_sleigh": "chaplygin_sleigh",
    "differential_drive": "differential_drive",
    "knife_edge_incline": "knife_edge_incline",
    "vertical_rolling_disk": "vertical_rolling_disk",
}
MECHANISMS = {zoo_name: mechanics.get(name) for name, zoo_name in SAME.items()} | {"trailer_1": n_trailer(1)}
RENAMED = {"trailer_1": {name.replace("_", ""): name for name in n_trailer(1).parameters}}


@pytest.mark.parametrize("name", MECHANISMS)
def test_zoo_vectors(name):
    mechanism, renamed = MECHANISMS[name], RENAMED.get(name, {})
    for vector in zoo.read(name)["test_vectors"]:
        params = {renamed.get(key, key): value for key, value in vector["params"].items()}
        assert params.keys() == mechanism.parameters.keys()
        actual = mechanics.acceleration(mechanism, vector["q"], vector["qdot"], vector["u"], params)
        scale = np.abs(vector["qddot"]).max()
        # The vectors hold 16 digits, and so does the velocity that they start from.
        np.testing.assert_allclose(actual, vector["qddot"], rtol=0, atol=1e-12 * scale)

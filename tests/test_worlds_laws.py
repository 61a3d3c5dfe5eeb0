"""The foreign laws are sound physics in form: finite, linear in their amplitude, losses where they claim to be, new."""

from worlds import laws

from mmrjax.effects import ALL


def test_every_effect_of_the_library_is_written_once_more():
    """`torque_offset` is `directional_friction` but at rest."""
    known = {law.cls for those in (laws.LIBRARY, laws.TRANSIENT, laws.RIGS, laws.LOGS) for law in those.values()}
    assert {e.name for e in ALL} - known == {"torque_offset"}

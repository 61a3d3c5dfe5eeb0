"""The library of effects. A new effect is one file and one line in `ALL`."""

from mmrjax.effects.adhesive_drag import AdhesiveDrag
from mmrjax.effects.ammeter_gain import AmmeterGain
from mmrjax.effects.ammeter_offset import AmmeterOffset
from mmrjax.effects.armature_inductance import ArmatureInductance
from mmrjax.effects.base import Effect
from mmrjax.effects.battery_sag import BatterySag
from mmrjax.effects.belt_creep import BeltCreep
from mmrjax.effects.bending_loss import BendingLoss
from mmrjax.effects.brush_drop import BrushDrop
from mmrjax.effects.centrifugal_tension import CentrifugalTension
from mmrjax.effects.churning import Churning
from mmrjax.effects.cogging import Cogging
from mmrjax.effects.curve import CURVES, WAVES
from mmrjax.effects.encoder_scale import EncoderScale
from mmrjax.effects.gear_load_loss import GearLoadLoss
from mmrjax.effects.gear_quadratic_loss import GearQuadraticLoss
from mmrjax.effects.grouser_polygon import GrouserPolygon
from mmrjax.effects.iron_loss import IronLoss
from mmrjax.effects.load_slip import LoadSlip
from mmrjax.effects.mass_error import MassError
from mmrjax.effects.mass_offset import MassOffset
from mmrjax.effects.nonlinear_slip import NonlinearSlip
from mmrjax.effects.pulley_eccentricity import PulleyEccentricity
from mmrjax.effects.rolling_radius import RollingRadius
from mmrjax.effects.rotating_inertia import RotatingInertia
from mmrjax.effects.series_resistance import SeriesResistance
from mmrjax.effects.sinkage import Sinkage
from mmrjax.effects.slope_bias import SlopeBias
from mmrjax.effects.speed_gain import SpeedGain
from mmrjax.effects.speed_rolling import SpeedRolling
from mmrjax.effects.speed_slip import SpeedSlip
from mmrjax.effects.stick_slip import StickSlip
from mmrjax.effects.stribeck_gear import StribeckGear
from mmrjax.effects.stribeck_motor import StribeckMotor
from mmrjax.effects.stribeck_track import StribeckTrack
from mmrjax.effects.supply_sag import SupplySag
from mmrjax.effects.tension_friction import TensionFriction
from mmrjax.effects.thermal_drift import ThermalDrift
from mmrjax.effects.torque_constant_saturation import TorqueConstantSaturation
from mmrjax.effects.weight_transfer import WeightTransfer
from mmrjax.effects.windage import Windage
from mmrjax.effects.winding_heating import WindingHeating

#: In the order of `balances.BALANCES`.
ALL: tuple[type[Effect], ...] = (
    MassError,
    MassOffset,
    RotatingInertia,
    SupplySag,
    BatterySag,
    SeriesResistance,
    BrushDrop,
    WindingHeating,
    ThermalDrift,
    ArmatureInductance,
    Windage,
    StribeckMotor,
    IronLoss,
    TorqueConstantSaturation,
    Cogging,
    GearLoadLoss,
    GearQuadraticLoss,
    StribeckGear,
    Churning,
    StribeckTrack,
    TensionFriction,
    CentrifugalTension,
    BendingLoss,
    StickSlip,
    SpeedRolling,
    AdhesiveDrag,
    WeightTransfer,
    Sinkage,
    SlopeBias,
    GrouserPolygon,
    RollingRadius,
    BeltCreep,
    NonlinearSlip,
    SpeedSlip,
    LoadSlip,
    PulleyEccentricity,
    AmmeterGain,
    AmmeterOffset,
    EncoderScale,
    SpeedGain,
)

BY_NAME: dict[str, type[Effect]] = {effect.name: effect for effect in ALL}

#: Discrepancies without a name, which robot files know and no library holds.
UNNAMED: dict[str, type[Effect]] = {**CURVES, **WAVES}

__all__ = ["ALL", "BY_NAME", "CURVES", "UNNAMED", "WAVES", "Effect"]

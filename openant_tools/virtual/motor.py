"""One servo's motor and gear as numbers: what its data sheet says, and every way in which it may fall short."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from openant_tools.robot.gains import CONTROL_PERIOD_S, D_DIVISOR, I_DIVISOR, P_DIVISOR
from openant_tools.robot.servo import ServoModel

__all__ = ["GEAR_STIFFNESS_NM_RAD", "MotorSettings"]

#: N·m/rad between rotor and output once the teeth touch; an assumption, stiff against every load of the robot.
GEAR_STIFFNESS_NM_RAD = 300.0
#: N·m, gear friction of a healthy joint: the platform's own figure for its model.
COULOMB_NM = 0.05


#: servo model → heat, where a data sheet says nothing: sizes that give the paper's stress test (half duty against a stall:
#: the XL430's case, plastic all round, passes 72 °C after half an hour; the XM430's, aluminium behind, comes to 80 °C).
_HEAT: Mapping[str, Mapping[str, float]] = {
    "XL430-W250-T": {"case_j_k": 48.0, "case_air_k_w": 16.5, "housing_k_w": 12.0, "winding_j_k": 8.0, "winding_case_k_w": 5.0},
    "XC430-W240-T": {"case_j_k": 55.0, "case_air_k_w": 14.5, "housing_k_w": 7.0, "winding_j_k": 7.0, "winding_case_k_w": 5.0},
    "XM430-W350-T": {"case_j_k": 68.0, "case_air_k_w": 10.8, "housing_k_w": 1.5, "winding_j_k": 7.0, "winding_case_k_w": 4.0},
    "XM430-W210-T": {"case_j_k": 68.0, "case_air_k_w": 10.8, "housing_k_w": 1.5, "winding_j_k": 7.0, "winding_case_k_w": 4.0},
}  # fmt: skip


@dataclass(slots=True)
class MotorSettings:
    """Motor, gear, sensor and heat of one servo, SI units at the output shaft.

    Attributes:
        kt, ke, resistance: N·m/A, V·s/rad, Ω (cold).
        armature: kg·m², rotor reflected to the output.
        p_divisor, i_divisor, d_divisor, control_period_s: of the firmware's position loop.
        standby_a: A drawn at rest.
        coulomb_nm, viscous: kinetic friction N·m and N·m·s/rad; viscous_quadratic N·m·s²/rad².
        static_nm, stribeck_rad_s: friction at rest, and the speed over which it falls to `coulomb_nm`.
        friction_bias_nm: friction is larger by this in the positive direction and smaller in the negative.
        load_friction: N·m of friction per N·m that the gear transmits.
        backlash_rad: full play. gear_stiffness: N·m/rad, used only with play or `compliant`.
        cogging_nm, cogging_periods: amplitude, and periods per turn of the output.
        strength: scale of the motor's torque. stiffness_scale: of the loop's P gain. torque_limit_nm: 0 for none.
        action_delay_s: from a goal's arrival to its effect. jitter_s: standard deviation of that time.
        lag_s: time constant between goal and loop. slew_rad_s: fastest goal, 0 for no limit.
        dead_zone_rad: full width around zero error in which the loop does nothing.
        dropout_fraction, dropout_s: share of goals that are lost, and the longest run of lost ones.
        sensor_delay_s: by how much position and velocity answers are old.
        velocity_filter_s: time constant of the reported velocity. encoder_noise_rad: standard deviation.
        current_noise_a: standard deviation of the reported current.
        winding_j_k, case_j_k, winding_case_k_w, case_air_k_w: two-node heat model; the sensor sits in the case.
        housing_k_w: the part of `case_air_k_w` that lies inside the housing, where no heat sink helps.
        heat_sink_k_w, heat_sink_j_k: from the housing's outside through a heat sink to the air, 0 for no sink; its mass.
        air_exponent: with what power of the rise over the room the exchange with air grows beyond the linear, as free
            convection and radiation do; `case_air_k_w` holds at 30 K.
        leg_w_k: heat that goes over to the other servo of the leg, W/K; the smaller of the two counts.
        copper_per_k: rise of resistance, magnet_per_k: loss of kt, per K of the winding over 25 °C.
        derating_per_k, derating_s: loss of torque per K of the case over 25 °C, and how slowly it follows.
        reset_v: supply below which the electronics restart; reset_s: for how long it must stay below.
    """

    kt: float
    ke: float
    resistance: float
    armature: float
    p_divisor: float = P_DIVISOR
    i_divisor: float = I_DIVISOR
    d_divisor: float = D_DIVISOR
    control_period_s: float = CONTROL_PERIOD_S
    standby_a: float = 0.046
    coulomb_nm: float = COULOMB_NM
    viscous: float = 0.0
    viscous_quadratic: float = 0.0
    static_nm: float = 0.0
    stribeck_rad_s: float = 0.1
    friction_bias_nm: float = 0.0
    load_friction: float = 0.0
    backlash_rad: float = 0.0
    gear_stiffness: float = GEAR_STIFFNESS_NM_RAD
    compliant: bool = False
    cogging_nm: float = 0.0
    cogging_periods: float = 0.0
    strength: float = 1.0
    stiffness_scale: float = 1.0
    torque_limit_nm: float = 0.0
    action_delay_s: float = 0.0
    jitter_s: float = 0.0
    lag_s: float = 0.0
    slew_rad_s: float = 0.0
    dead_zone_rad: float = 0.0
    dropout_fraction: float = 0.0
    dropout_s: float = 0.0
    sensor_delay_s: float = 0.0
    # Unpublished: how the firmware filters its velocity.
    velocity_filter_s: float = 0.005
    encoder_noise_rad: float = 0.0002
    current_noise_a: float = 0.004
    # Orders of magnitude from the platform's own temperature log: case τ ≈ 480 s, stalled at half duty to the limit.
    winding_j_k: float = 8.0
    case_j_k: float = 40.0
    winding_case_k_w: float = 5.0
    case_air_k_w: float = 12.0
    housing_k_w: float = 3.0
    heat_sink_k_w: float = 0.0
    heat_sink_j_k: float = 0.0
    air_exponent: float = 0.15
    leg_w_k: float = 0.01
    copper_per_k: float = 0.0039
    magnet_per_k: float = 0.001
    derating_per_k: float = 0.0
    derating_s: float = 0.0
    reset_v: float = 4.8
    reset_s: float = 0.0005

    @classmethod
    def of(cls, model: ServoModel) -> MotorSettings:
        """A healthy servo as its data sheet promises it."""
        return cls(
            kt=model.kt_nm_a,
            ke=model.ke_v_s_rad,
            resistance=model.resistance_ohm,
            armature=model.armature_kg_m2,
            p_divisor=model.position_p_divisor,
            standby_a=model.standby_current_a,
            **_HEAT.get(model.name, {}),  # type: ignore[arg-type]
        )

    @property
    def elastic(self) -> bool:
        """Whether rotor and output move apart."""
        return self.compliant or self.backlash_rad > 0

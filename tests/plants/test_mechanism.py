from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    JacobianWrtVariable,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)

from plants.mechanism import Mechanism, add_force, place_links
from systems.compiled import compiled

RNG = np.random.default_rng(0)


def crooked(*numbers: float) -> RigidTransform:
    return RigidTransform(RollPitchYaw(numbers[:3]), numbers[3:])


def tree() -> tuple[MultibodyPlant, list[RigidBody]]:
    """A body that floats, with a branched arm; another on two slides; frames askew everywhere."""
    plant = MultibodyPlant(0.01)
    inertia = SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3)
    names = ("base", "upper", "lower", "tip", "side", "slider", "turner", "anchored")
    bodies = {name: plant.AddRigidBody(name, inertia) for name in names}

    def frames(parent: RigidBody, child: RigidBody) -> list[FixedOffsetFrame]:
        found = []
        for body in (parent, child):
            X = crooked(*RNG.uniform(-1, 1, 6))
            name = f"{parent.name()}_{child.name()}_{body.name()}"
            found.append(plant.AddFrame(FixedOffsetFrame(name, body.body_frame(), X)))
        return found

    def turning(parent: str, child: str) -> None:
        axis = RNG.normal(size=3)
        ends = frames(bodies[parent], bodies[child])
        plant.AddJoint(RevoluteJoint(child, *ends, axis))

    turning("base", "upper")
    turning("upper", "lower")
    turning("base", "side")
    plant.WeldFrames(*frames(bodies["lower"], bodies["tip"]), crooked(*RNG.uniform(-1, 1, 6)))
    ends = frames(plant.world_body(), bodies["slider"])
    plant.AddJoint(PrismaticJoint("slider", *ends, RNG.normal(size=3)))
    turning("slider", "turner")
    plant.WeldFrames(*frames(plant.world_body(), bodies["anchored"]))
    plant.Finalize()
    return plant, [bodies[name] for name in names]


@pytest.mark.parametrize("seed", range(3))
def test_poses_are_drakes(seed: int) -> None:
    plant, bodies = tree()
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(seed)
    for chosen in (bodies, bodies[::-1], bodies[3:4], [plant.world_body(), bodies[6]]):
        q = rng.normal(size=plant.num_positions())
        plant.SetPositions(context, q)
        R, p = Mechanism(plant, chosen).poses(np.r_[q, np.full(plant.num_velocities(), np.nan)])
        for k, body in enumerate(chosen):
            X_WB = plant.EvalBodyPoseInWorld(context, body)
            np.testing.assert_allclose(R[k], X_WB.rotation().matrix(), atol=1e-12)
            np.testing.assert_allclose(p[k], X_WB.translation(), atol=1e-12)


@compiled("void(i8[:,::1], f8[:,::1], f8[::1], i8, f8[::1], f8[::1])")
def push(
    links: np.ndarray, shapes: np.ndarray, q: np.ndarray, k: int, F: np.ndarray, tau: np.ndarray
) -> None:
    n = len(links)
    R, p, pivots, axes = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    place_links(links, shapes, q, R, p, pivots, axes)
    add_force(links, p, pivots, axes, k, F, tau)


def test_forces_do_to_the_joints_what_drakes_jacobian_says() -> None:
    plant, bodies = tree()
    context = plant.CreateDefaultContext()
    q = np.random.default_rng(5).normal(size=plant.num_positions())
    plant.SetPositions(context, q)
    q = plant.GetPositions(context).copy()
    mechanism, world = Mechanism(plant, bodies), plant.world_frame()
    for place, body in zip(mechanism.places, bodies, strict=True):
        F, tau = np.random.default_rng(6).normal(size=3), np.zeros(plant.num_velocities())
        push(mechanism.links, mechanism.shapes, q, place, F, tau)
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, body.body_frame(), np.zeros(3), world, world
        )
        np.testing.assert_allclose(tau, J.T @ F, atol=1e-12)
        assert np.any(tau) == (body.name() != "anchored")


def test_a_joint_of_another_kind_is_refused() -> None:
    plant = MultibodyPlant(0.01)
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3))
    plant.AddJoint(BallRpyJoint("neck", plant.world_frame(), body.body_frame()))
    plant.Finalize()
    with pytest.raises(ValueError, match="neck is 'ball_rpy': must be welded, revolute"):
        Mechanism(plant, [body])

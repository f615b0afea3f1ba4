from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from plants.relative_pose import RelativePose

X_CF = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), [0.01, 0.02, -0.03])


@dataclass
class Scene:
    """Two bodies that fly, and blocks that say where one is."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    parent: RigidBody
    child: RigidBody
    diagram: Diagram
    blocks: dict[str, RelativePose]

    def place(self, context: Context, seed: int) -> tuple[RigidTransform, RigidTransform]:
        random = np.random.default_rng(seed)
        own = self.plant.GetMyMutableContextFromRoot(context)
        poses = []
        for body in (self.parent, self.child):
            X = RigidTransform(RollPitchYaw(random.uniform(-1.5, 1.5, 3)), random.normal(size=3))
            self.plant.SetFreeBodyPose(own, body, X)
            poses.append(X)
        return poses[0], poses[1]

    def told(self, name: str, context: Context) -> RigidTransform:
        block = self.blocks[name]
        # What a port gives is the cache's own, which the next evaluation overwrites.
        return RigidTransform(block.pose_output_port().Eval(block.GetMyContextFromRoot(context)))


@pytest.fixture(scope="module")
def scene() -> Scene:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    parent, child = (plant.AddRigidBody(name, inertia) for name in ("parent", "child"))
    plant.Finalize()
    P, C = (plant.GetBodyFrameIdOrThrow(body.index()) for body in (parent, child))
    blocks = {
        "child": RelativePose(parent=P, child=C),
        "offset": RelativePose(parent=P, child=C, X_CF=X_CF),
        "world": RelativePose(parent=scene_graph.world_frame_id(), child=C),
        "itself": RelativePose(parent=P, child=P),
    }
    for block in blocks.values():
        builder.AddSystem(block)
        builder.Connect(scene_graph.get_query_output_port(), block.query_object_input_port())
    return Scene(plant, scene_graph, parent, child, builder.Build(), blocks)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_childs_pose_as_seen_from_the_parent(scene: Scene, seed: int) -> None:
    context = scene.diagram.CreateDefaultContext()
    X_WP, X_WC = scene.place(context, seed)
    # By what the parent sees: points of the child, carried through the world.
    told, points = scene.told("child", context), np.random.default_rng(seed).normal(size=(3, 4))
    np.testing.assert_allclose(X_WP @ (told @ points), X_WC @ points, atol=1e-12)
    beyond = scene.told("offset", context)
    np.testing.assert_allclose(X_WP @ (beyond @ points), X_WC @ (X_CF @ points), atol=1e-12)


def test_of_the_world_and_of_itself(scene: Scene) -> None:
    context = scene.diagram.CreateDefaultContext()
    _, X_WC = scene.place(context, seed=7)
    assert scene.told("world", context).IsNearlyEqualTo(X_WC, 1e-14)
    assert scene.told("itself", context).IsNearlyEqualTo(RigidTransform(), 1e-14)


def test_it_follows_when_either_moves(scene: Scene) -> None:
    context = scene.diagram.CreateDefaultContext()
    scene.place(context, seed=8)
    before = scene.told("child", context)
    own = scene.plant.GetMyMutableContextFromRoot(context)
    X_WP = RigidTransform([0.5, 0.0, 0.0])
    scene.plant.SetFreeBodyPose(own, scene.parent, X_WP)
    after = scene.told("child", context)
    assert not after.IsNearlyEqualTo(before, 1e-3)
    X_WC = scene.plant.EvalBodyPoseInWorld(own, scene.child)
    assert after.IsNearlyEqualTo(RigidTransform([-0.5, 0.0, 0.0]) @ X_WC, 1e-14)


def test_both_moved_alike_it_stays(scene: Scene) -> None:
    context = scene.diagram.CreateDefaultContext()
    bodies = zip((scene.parent, scene.child), scene.place(context, seed=9), strict=True)
    before = scene.told("offset", context)
    own = scene.plant.GetMyMutableContextFromRoot(context)
    for body, X in bodies:
        scene.plant.SetFreeBodyPose(own, body, X_CF @ X)
    assert scene.told("offset", context).IsNearlyEqualTo(before, 1e-13)

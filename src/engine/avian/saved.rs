//! Engine state beyond the components: where links really are, and the impulses of joints and
//! contacts.

use avian3d::collision::contact_types::{ContactEdgeFlags, ContactPairFlags, PackedFeatureId};
use avian3d::prelude::{
    AngularVelocity, ContactGraph, ContactManifold, ContactPoint, LinearVelocity, Position, Rotation,
};
use bevy_ecs::prelude::World;
use bevy_math::{Quat, Vec2, Vec3};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::world::{Tangents, push_contacts};
use super::{Chunk, Worlds};

/// One robot, with all its bits.
#[derive(Serialize, Deserialize)]
pub(crate) struct SavedRobot {
    /// Origin of its env in the world.
    origin: [f64; 3],
    /// Position, rotation, linear and angular velocity of the base.
    base: ([f64; 3], [f64; 4], [f64; 3], [f64; 3]),
    links: Vec<SavedLink>,
    joints: Vec<SavedJoint>,
    contacts: Vec<SavedPair>,
}

#[derive(Serialize, Deserialize)]
struct SavedLink {
    position: [f32; 3],
    rotation: [f32; 4],
    linear: [f32; 3],
    angular: [f32; 3],
}

#[derive(Serialize, Deserialize)]
struct SavedJoint {
    position: f64,
    velocity: f64,
    target: f32,
    feedforward: f32,
    kept: [f32; 3],
}

/// Contact between two colliders in the last physics step.
#[derive(Serialize, Deserialize)]
struct SavedPair {
    /// Index of the pair among those of the robot.
    place: u32,
    tangents: [[f32; 3]; 2],
    manifolds: Vec<Vec<SavedPoint>>,
}

#[derive(Serialize, Deserialize)]
struct SavedPoint {
    anchors: [[f32; 3]; 2],
    features: [u32; 2],
    normal: f32,
    tangent: [f32; 2],
}

impl Worlds {
    /// The robot of an env, as bytes.
    pub(crate) fn save(&self, env: usize) -> Result<Vec<u8>, postcard::Error> {
        let (chunk, i) = self.at(env);
        postcard::to_stdvec(&chunk.save(i, self.topology.num_links()))
    }

    /// Restores the robots of all envs. With the same parameters of the envs, steps from there have
    /// the same bits. Bytes that are no such robots change nothing.
    pub(crate) fn load(&mut self, envs: &[Vec<u8>]) -> Result<(), postcard::Error> {
        let robots = self.saved(envs)?;
        let mut rest = robots.as_slice();
        for chunk in &mut self.chunks {
            let (mine, more) = rest.split_at(chunk.envs.len());
            rest = more;
            for (i, robot) in mine.iter().enumerate() {
                chunk.load(i, robot);
            }
            push_contacts(&mut chunk.world);
        }
        Ok(())
    }

    /// The robots of all envs, if the bytes hold such robots.
    pub(crate) fn saved(&self, envs: &[Vec<u8>]) -> Result<Vec<SavedRobot>, postcard::Error> {
        let robots = envs.iter().map(|bytes| postcard::from_bytes(bytes)).collect::<Result<Vec<SavedRobot>, _>>()?;
        let (links, joints) = (self.topology.num_links(), self.topology.num_joints());
        let fits = |robot: &SavedRobot| robot.links.len() == links && robot.joints.len() == joints;
        if robots.len() != self.chunks.iter().map(|chunk| chunk.envs.len()).sum::<usize>() || !robots.iter().all(fits) {
            return Err(postcard::Error::DeserializeBadEncoding);
        }
        Ok(robots)
    }
}

impl Chunk {
    fn save(&self, env: usize, links: usize) -> SavedRobot {
        let state = &self.envs[env].state;
        let joints = state.joint_position.len();
        let (pairs, tangents) = (self.pairs(env), self.world.get_resource::<Tangents>());
        let all = self.world.get_resource::<ContactGraph>().map(ContactGraph::active_pairs).unwrap_or_default();
        let contacts = all.get(pairs.clone()).unwrap_or_default().iter().enumerate();
        let contacts = contacts.filter(|(_, pair)| !pair.manifolds.is_empty()).map(|(place, pair)| SavedPair {
            place: place as u32,
            tangents: tangents
                .and_then(|tangents| tangents.0.get(pairs.start + place))
                .map_or([[0.0; 3]; 2], |both| both.map(|t| t.to_array())),
            manifolds: pair
                .manifolds
                .iter()
                .map(|manifold| manifold.points.iter().map(SavedPoint::new).collect())
                .collect(),
        });
        SavedRobot {
            origin: self.envs[env].origin.to_array(),
            base: (state.position, state.rotation, state.linear_velocity, state.angular_velocity),
            links: self.bodies.links[env * links..(env + 1) * links]
                .iter()
                .filter_map(|&link| {
                    Some(SavedLink {
                        position: self.world.get::<Position>(link)?.0.to_array(),
                        rotation: self.world.get::<Rotation>(link)?.0.to_array(),
                        linear: self.world.get::<LinearVelocity>(link)?.0.to_array(),
                        angular: self.world.get::<AngularVelocity>(link)?.0.to_array(),
                    })
                })
                .collect(),
            joints: self.joints.all[env * joints..(env + 1) * joints]
                .iter()
                .map(|joint| SavedJoint {
                    position: joint.position,
                    velocity: joint.velocity,
                    target: joint.target,
                    feedforward: joint.feedforward,
                    kept: joint.kept(),
                })
                .collect(),
            contacts: contacts.collect(),
        }
    }

    fn load(&mut self, env: usize, saved: &SavedRobot) {
        let (joints, links) = (saved.joints.len(), saved.links.len());
        for (link, at) in saved.links.iter().enumerate() {
            let entity = self.bodies.links[env * links + link];
            self.set(entity, Position(Vec3::from_array(at.position)));
            self.set(entity, Rotation(Quat::from_array(at.rotation)));
            self.set(entity, LinearVelocity(Vec3::from_array(at.linear)));
            self.set(entity, AngularVelocity(Vec3::from_array(at.angular)));
        }
        self.envs[env].origin = DVec3::from_array(saved.origin);
        let state = &mut self.envs[env].state;
        (state.position, state.rotation, state.linear_velocity, state.angular_velocity) = saved.base;
        for (j, from) in saved.joints.iter().enumerate() {
            (state.joint_position[j], state.joint_velocity[j]) = (from.position, from.velocity);
            let joint = &mut self.joints.all[env * joints + j];
            (joint.position, joint.velocity) = (from.position, from.velocity);
            (joint.target, joint.feedforward) = (from.target, from.feedforward);
            joint.keep(from.kept);
        }
        let pairs = self.pairs(env);
        load_contacts(&mut self.world, pairs, &saved.contacts);
    }
}

fn load_contacts(world: &mut World, pairs: std::ops::Range<usize>, saved: &[SavedPair]) {
    world.resource_scope(|world, mut tangents: bevy_ecs::prelude::Mut<Tangents>| {
        let Some(mut graph) = world.get_resource_mut::<ContactGraph>() else {
            return;
        };
        let all = graph.active_pairs().len();
        tangents.0.resize(all, [Vec3::ZERO; 2]);
        for pair in pairs.clone().filter(|pair| *pair < all) {
            let from = saved.iter().find(|from| from.place as usize == pair - pairs.start);
            let to = &mut graph.active_pairs_mut()[pair];
            to.manifolds = from.map_or_else(Vec::new, SavedPair::manifolds);
            to.flags.set(ContactPairFlags::TOUCHING, from.is_some());
            let id = to.contact_id;
            if let Some(edge) = graph.get_edge_mut_by_id(id) {
                edge.flags.set(ContactEdgeFlags::TOUCHING, from.is_some());
            }
            tangents.0[pair] = from.map_or([Vec3::ZERO; 2], |from| from.tangents.map(Vec3::from_array));
        }
    });
}

impl SavedPair {
    /// Manifolds with the data that the next step reads. It finds contacts again and recognises
    /// them by their features or places.
    fn manifolds(&self) -> Vec<ContactManifold> {
        let points = |points: &Vec<SavedPoint>| points.iter().map(SavedPoint::point).collect::<Vec<_>>();
        self.manifolds.iter().map(|manifold| ContactManifold::new(points(manifold), Vec3::ZERO)).collect()
    }
}

impl SavedPoint {
    fn new(point: &ContactPoint) -> Self {
        Self {
            anchors: [point.anchor1.to_array(), point.anchor2.to_array()],
            features: [point.feature_id1.0, point.feature_id2.0],
            normal: point.warm_start_normal_impulse,
            tangent: point.warm_start_tangent_impulse.to_array(),
        }
    }

    fn point(&self) -> ContactPoint {
        let [anchor1, anchor2] = self.anchors.map(Vec3::from_array);
        let [first, second] = self.features.map(PackedFeatureId);
        let mut point = ContactPoint::new(anchor1, anchor2, Vec3::ZERO, 0.0).with_feature_ids(first, second);
        point.warm_start_normal_impulse = self.normal;
        point.warm_start_tangent_impulse = Vec2::from_array(self.tangent);
        point
    }
}

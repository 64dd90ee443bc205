//! Tree of the links; refuses everything that is not one tree.

use std::collections::HashMap;
use std::path::Path;

use urdf_rs::JointType;

use super::error::{Diagnosis, RobotError, Warning, listed, nearest_name};

/// The tree that the joints of a URDF span over its links; indices are positions in the file.
#[derive(Debug)]
pub(super) struct Tree {
    /// The link everything hangs on.
    pub root: usize,
    /// Parent and child link of each joint.
    pub ends: Vec<(usize, usize)>,
    /// Joints whose parent is this link, in the file's order.
    pub joints_below: Vec<Vec<usize>>,
    /// A floating joint above the root, which stands for the free base and is no joint here.
    pub dropped_joint: Option<usize>,
}

impl Tree {
    /// # Errors
    /// [`RobotError::Structure`] for repeated names, unknown or twice hung links, loops, and
    /// anything but one root.
    pub fn build(robot: &urdf_rs::Robot, file: &Path, warnings: &mut Vec<Warning>) -> Result<Self, RobotError> {
        let error = |element: String, problem: String, remedy: &str| {
            Err(RobotError::Structure(Diagnosis::new(file, element, problem, remedy)))
        };
        if robot.links.is_empty() {
            return error("<robot>".into(), "has no links".into(), "add a <link> for each rigid part");
        }
        let mut link_of: HashMap<&str, usize> = HashMap::new();
        for (index, link) in robot.links.iter().enumerate() {
            if link_of.insert(&link.name, index).is_some() {
                return error(
                    format!("link \"{}\"", link.name),
                    "is defined twice".into(),
                    "rename or remove one of them",
                );
            }
        }
        let mut joint_above: Vec<Option<usize>> = vec![None; robot.links.len()];
        let mut joints_below = vec![Vec::new(); robot.links.len()];
        let mut ends = Vec::with_capacity(robot.joints.len());
        let mut names: HashMap<&str, usize> = HashMap::new();
        for (index, joint) in robot.joints.iter().enumerate() {
            let element = format!("joint \"{}\"", joint.name);
            if names.insert(&joint.name, index).is_some() {
                return error(element, "is defined twice".into(), "rename or remove one of them");
            }
            let mut end = [0; 2];
            for (slot, (role, name)) in
                end.iter_mut().zip([("parent", &joint.parent.link), ("child", &joint.child.link)])
            {
                let Some(&link) = link_of.get(name.as_str()) else {
                    let known = robot.links.iter().map(|link| link.name.as_str());
                    let problem = format!("its {role} link \"{name}\" does not exist");
                    return error(element, problem, &nearest_name(name, known));
                };
                *slot = link;
            }
            let [parent, child] = end;
            if let Some(other) = joint_above[child].replace(index) {
                return error(
                    format!("link \"{}\"", robot.links[child].name),
                    format!("hangs on two joints, \"{}\" and \"{}\"", robot.joints[other].name, joint.name),
                    "cut the loop: a link has one parent",
                );
            }
            joints_below[parent].push(index);
            ends.push((parent, child));
        }

        let roots: Vec<usize> = (0..robot.links.len()).filter(|link| joint_above[*link].is_none()).collect();
        let mut tree = match roots[..] {
            [root] => Self { root, ends, joints_below, dropped_joint: None },
            [] => {
                return error(
                    "<robot>".into(),
                    "its joints form a loop: every link is some joint's child".into(),
                    "let one link be nobody's child",
                );
            }
            _ => {
                let names = listed(roots.iter().map(|root| robot.links[*root].name.as_str()));
                return error(
                    "<robot>".into(),
                    format!("has {} root links: {names}", roots.len()),
                    "connect them by joints to one root, or remove what is not part of the robot",
                );
            }
        };
        if let Some(link) = tree.unreachable_link() {
            return error(
                format!("link \"{}\"", robot.links[link].name),
                "is part of a loop of joints that does not hang on the root".into(),
                "hang it on another link",
            );
        }
        tree.drop_floating_root(robot, file, warnings);
        Ok(tree)
    }

    /// A link that the root does not reach. With one parent per link, such links run in circles.
    fn unreachable_link(&self) -> Option<usize> {
        let mut reached = vec![false; self.joints_below.len()];
        let mut stack = vec![self.root];
        while let Some(link) = stack.pop() {
            reached[link] = true;
            stack.extend(self.joints_below[link].iter().map(|joint| self.ends[*joint].1));
        }
        reached.iter().position(|reached| !reached)
    }

    /// The base floats anyway, so that an empty link above it on a floating joint says nothing.
    fn drop_floating_root(&mut self, robot: &urdf_rs::Robot, file: &Path, warnings: &mut Vec<Warning>) {
        let root = &robot.links[self.root];
        let [joint] = self.joints_below[self.root][..] else {
            return;
        };
        let floating = robot.joints[joint].joint_type == JointType::Floating;
        if !floating || root.inertial.mass.value > 0.0 || !root.collision.is_empty() {
            return;
        }
        let base = self.ends[joint].1;
        warnings.push(Warning::new(
            file,
            format!("joint \"{}\"", robot.joints[joint].name),
            format!(
                "a floating joint below the empty link \"{}\" is left out, \"{}\" is the base",
                root.name, robot.links[base].name
            ),
            "remove both: the base always floats",
        ));
        self.dropped_joint = Some(joint);
        self.root = base;
    }
}

//! Tables that the robots of a block share: topology and settings as lists of numbers.

use std::fmt::Write;
use std::sync::Arc;

use polypod_dynamics::math::{add_scaled, cross, dot, scale};
use polypod_dynamics::{
    ActuatorNetwork, Axis, ContactFriction, ContactKind, JointMotion, PairTopology, Plane, SWEEPS, StepSettings,
    Topology,
};

use crate::heights::Heights;
use crate::layout::*;
use crate::networks::{num_features, write_networks};

/// Bytes of constant memory that a kernel has (CUDA C++ Programming Guide, 17.2).
const CONSTANT_BYTES: usize = 64 << 10;

/// A feature that the text of the device does not have yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unsupported {
    /// A morphology whose numbers an index of 32 bits does not count.
    #[error(
        "the morphology has more numbers than the device can count; use fewer links or contacts, or smaller networks"
    )]
    TooLarge,
}

/// Ground, networks and forces around the robots of a block.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scene<'a> {
    /// Ground that replaces the settings' plane, which must be level then.
    pub terrain: Option<&'a Heights>,
    /// Networks that drive joints.
    pub networks: &'a [ActuatorNetwork],
    /// Control steps whose targets are remembered, the present one included.
    pub ages: usize,
    /// Link and frame of each force from outside, in rising order: keys of
    /// [`LinkForce`](polypod_dynamics::LinkForce).
    pub link_forces: &'a [(usize, bool)],
}

/// Tables, and the sizes of columns and rows.
#[derive(Clone, Debug)]
pub struct Tables {
    /// Table of integers.
    pub integers: Vec<i32>,
    /// Table of numbers.
    pub numbers: Vec<f32>,
    /// Heights of the grid, `[x][y]`, then the largest heights of its squares; empty on a plane.
    pub grid: Arc<[f32]>,
    /// Numbers of a robot in each list.
    pub sizes: Sizes,
}

/// Numbers of a robot in each list.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sizes {
    /// Parameters.
    pub parameters: usize,
    /// State, with an empty list of impulses.
    pub state: usize,
    /// Drive.
    pub drive: usize,
    /// Report.
    pub report: usize,
    /// Scratch memory.
    pub work: usize,
    /// Integers of scratch memory.
    pub work_integers: usize,
    /// Numbers of scratch memory that each tile has for the features of networks.
    pub features: usize,
    /// Contacts, and rows of torsional and rolling friction, that may press at a time.
    pub impulses: usize,
}

/// Lists that begin one after the other: where each begins goes to the table of integers.
struct Places<'a> {
    integers: &'a mut [usize],
    next: usize,
}

impl Places<'_> {
    fn list(&mut self, name: usize, len: usize) -> &mut Self {
        self.integers[name] = self.next;
        self.next += len;
        self
    }
}

impl Tables {
    /// Tables of a morphology.
    ///
    /// # Errors
    /// A feature that the device lacks.
    pub fn new(topology: &Topology, settings: &StepSettings, scene: &Scene) -> Result<Self, Unsupported> {
        let Scene { terrain, networks, link_forces, .. } = *scene;
        let mut header = vec![0; NUM_INTEGERS];
        let mut lists = Lists { integers: Vec::new(), numbers: vec![0.0; NUM_NUMBERS] };
        let stride = lists.topology(topology, link_forces, &mut header);
        write_networks(networks, &mut header, &mut lists);
        sizes_and_settings(topology, settings, scene, stride, &mut header);
        write_settings(settings, &mut lists.numbers[..NUM_NUMBERS]);
        if let Some(heights) = terrain {
            write_grid(heights, &mut header, &mut lists.numbers);
        }
        let grid = terrain.map_or_else(|| Arc::from([]), |heights| heights.numbers.clone());
        let sizes = place_columns(topology, settings, scene, stride, &mut header);
        for (name, size) in [
            (SIZE_PARAMETERS, sizes.parameters),
            (SIZE_STATE, sizes.state),
            (SIZE_DRIVE, sizes.drive),
            (SIZE_REPORT, sizes.report),
            (SIZE_WORK, sizes.work),
            (SIZE_WORK_INTEGERS, sizes.work_integers),
        ] {
            header[name] = size;
            // places in a tile are counted in 32 bits, whatever the number of its robots
            let most = WARP.checked_mul(size + LISTED_SIZE * sizes.impulses);
            most.and_then(|most| i32::try_from(most).ok()).ok_or(Unsupported::TooLarge)?;
        }
        let integers = header.into_iter().chain(lists.integers).map(i32::try_from).collect::<Result<_, _>>();
        let integers = integers.map_err(|_| Unsupported::TooLarge)?;
        Ok(Self { integers, numbers: lists.numbers, grid, sizes })
    }

    /// The same tables where scratch memory is in tiles of another number of robots.
    #[must_use]
    pub(crate) fn with_tile(mut self, before: usize, tile: usize) -> Self {
        let Sizes { work, features, .. } = &mut self.sizes;
        *work = *work - *features / before + *features / tile;
        // never fails: a tile has no more numbers than `new` has counted
        self.integers[SIZE_WORK] = i32::try_from(*work).unwrap_or(i32::MAX);
        self
    }

    /// The tables as a header of the device's text, with which it is the text of this morphology
    /// alone: all sizes are constants. Absent if a number is not finite, which C cannot write, or
    /// if the tables do not fit into a card's constant memory.
    pub fn header(&self) -> Option<String> {
        if size_of::<i32>() * (self.integers.len() + self.numbers.len()) > CONSTANT_BYTES {
            return None;
        }
        let mut text = String::new();
        for &(name, place) in INTEGER_PLACES.iter().filter(|(_, place)| *place < NUM_INTEGERS) {
            writeln!(text, "#define INTEGER_{name} {}", self.integers[place]).ok()?;
        }
        for &(name, place) in NUMBER_PLACES.iter().filter(|(_, place)| *place < NUM_NUMBERS) {
            writeln!(text, "#define NUMBER_{name} ({})", exact(self.numbers[place])).ok()?;
        }
        let integers: Vec<String> = self.integers.iter().map(i32::to_string).collect();
        let numbers: Vec<String> = self.numbers.iter().copied().map(exact).collect();
        writeln!(text, "TABLE int INTEGERS[] = {{{}}};", integers.join(",")).ok()?;
        writeln!(text, "TABLE float NUMBERS[] = {{{}}};", numbers.join(",")).ok()?;
        self.numbers.iter().all(|number| number.is_finite()).then_some(text)
    }

    /// An entry of the table of integers that is never negative.
    pub(crate) fn at(&self, name: usize) -> usize {
        usize::try_from(self.integers[name]).unwrap_or(0)
    }
}

/// A finite number as a literal of C, without rounding.
fn exact(number: f32) -> String {
    let bits = number.to_bits();
    let (sign, exponent, fraction) = (if bits >> 31 == 1 { "-" } else { "" }, bits >> 23 & 0xFF, bits & 0x7F_FFFF);
    let whole = if exponent == 0 { fraction } else { fraction | 0x80_0000 };
    format!("{sign}0x{whole:X}p{}f", exponent.max(1) as i32 - 150)
}

/// Lists of the tables. Places in the table of integers count from its beginning, behind the
/// header.
pub(crate) struct Lists {
    pub(crate) integers: Vec<usize>,
    pub(crate) numbers: Vec<f32>,
}

impl Lists {
    /// The place of the next integer.
    pub(crate) fn here(&self) -> usize {
        NUM_INTEGERS + self.integers.len()
    }

    /// Writes the lists of a topology. Returns the blocks after the first that rows have room for.
    fn topology(&mut self, topology: &Topology, link_forces: &[(usize, bool)], header: &mut [usize]) -> usize {
        self.joints(topology, header);
        self.blocks(topology, header);
        let longest = self.paths(topology, header);
        self.colliders(topology, header);
        header[C_RIM] = self.numbers.len();
        header[T_CONTACT] = self.here();
        for contact in &topology.contacts {
            let (is_rim, rim) = match contact.kind {
                ContactKind::Point => (false, [0.0; RIM_SIZE]),
                ContactKind::Rim { across: [a, b], turn: [c, s] } => (true, [a[0], a[1], a[2], b[0], b[1], b[2], c, s]),
            };
            self.integers.extend([contact.link, contact.body, usize::from(is_rim)]);
            self.numbers.extend(rim.map(|x| x as f32));
        }
        header[T_LINK_CONTACTS] = self.here();
        self.integers.push(0);
        self.integers.extend((0..topology.num_links()).map(|link| topology.contacts_of(link).end));
        header[T_SITE] = self.here();
        self.integers.extend(&topology.sites);
        header[T_FORCE] = self.here();
        self.integers.extend(link_forces.iter().flat_map(|&(link, in_world)| [link, usize::from(in_world)]));
        longest.saturating_sub(1).max(1)
    }

    fn joints(&mut self, topology: &Topology, header: &mut [usize]) {
        header[C_AXIS] = self.numbers.len();
        for joint in &topology.joints {
            let direction = joint.axis.direction();
            let sign = match joint.axis {
                Axis::X(sign) | Axis::Y(sign) | Axis::Z(sign) => sign,
                Axis::General(_) => 1.0,
            };
            self.numbers.extend([direction[0], direction[1], direction[2], sign].map(|x| x as f32));
        }
        header[T_JOINT] = self.here();
        for joint in &topology.joints {
            let axis = match joint.axis {
                Axis::X(_) => 0,
                Axis::Y(_) => 1,
                Axis::Z(_) => 2,
                Axis::General(_) => 3,
            };
            // the settings come first: no table begins at 0
            let (table, length) = match &joint.effort_table {
                Some(table) => {
                    let at = self.numbers.len();
                    self.numbers.extend([table.start, table.inverse_step]);
                    self.numbers.extend(&table.limits);
                    (at, table.limits.len())
                }
                None => (0, 0),
            };
            let slides = usize::from(joint.motion == JointMotion::Prismatic);
            self.integers.extend([joint.parent, slides, axis, usize::from(joint.explicit), table, length]);
        }
    }

    /// Blocks, their carriers, and the trees that the base carries.
    fn blocks(&mut self, topology: &Topology, header: &mut [usize]) {
        let blocks = topology.blocks();
        let carriers = self.here();
        header[T_CARRIER] = carriers;
        let all = blocks.iter().flat_map(|block| topology.carriers_of(block));
        self.integers.extend(all.flat_map(|carrier| [carrier.block, carrier.count]));
        header[T_BLOCK] = self.here();
        for block in blocks {
            let (count, first) = (block.num_carriers, block.first_coupling);
            self.integers.extend(block.joints);
            self.integers.extend([block.len, count, carriers + CARRIER_SIZE * first, first]);
        }
        let mut trees: Vec<Vec<usize>> = Vec::new();
        for (b, block) in blocks.iter().enumerate() {
            let root = topology.carriers_of(block).last().map(|carrier| carrier.block);
            match trees.iter_mut().find(|tree| tree.first().copied() == root) {
                Some(tree) => tree.push(b),
                None => trees.push(vec![b]),
            }
        }
        let mut first = self.here();
        let starts = trees.iter().flat_map(|tree| {
            first += tree.len();
            [tree.len(), first - tree.len()]
        });
        let starts: Vec<usize> = starts.collect();
        self.integers.extend(trees.iter().flatten());
        header[T_TREE] = self.here();
        header[TREES] = trees.len();
        self.integers.extend(starts);
    }

    /// Paths of the links to the base, then those of the pairs of links. Returns the number of
    /// parts of the longest.
    fn paths(&mut self, topology: &Topology, header: &mut [usize]) -> usize {
        let blocks = topology.blocks();
        let mut paths = paths_of_links(topology);
        let of_pairs: Vec<_> =
            topology.pairs.iter().map(|pair| path_of_both(&paths, links_of(topology, pair))).collect();
        paths.extend(of_pairs);
        let mut starts = Vec::new();
        for path in &paths {
            // the places in the path of the carriers of each of its blocks
            let place = |block: usize| path.iter().position(|&(other, _)| other == block);
            let mut parts = Vec::new();
            for &(block, count) in path {
                let places: Vec<usize> =
                    topology.carriers_of(&blocks[block]).iter().filter_map(|c| place(c.block)).collect();
                parts.extend([block, count, places.len(), self.here()]);
                self.integers.extend(places);
            }
            starts.extend([path.len(), self.here()]);
            self.integers.extend(parts);
        }
        header[T_PATH] = self.here();
        self.integers.extend(starts);
        paths.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// Colliders and the pairs of them that may touch.
    fn colliders(&mut self, topology: &Topology, header: &mut [usize]) {
        header[C_BOX] = self.numbers.len();
        header[T_COLLIDER] = self.here();
        for collider in &topology.colliders {
            self.integers.extend([collider.link, collider.body, usize::from(collider.box_rotation.is_some())]);
            let rotation = collider.box_rotation.unwrap_or_default();
            self.numbers.extend(rotation.as_flattened().iter().map(|&x| x as f32));
        }
        let mut starts = Vec::new();
        for link in 0..topology.num_links() {
            let all = topology.colliders.iter().enumerate();
            let of_link: Vec<usize> = all.filter(|(_, c)| c.link == link).map(|(place, _)| place).collect();
            starts.extend([of_link.len(), self.here()]);
            self.integers.extend(of_link);
        }
        header[T_LINK_COLLIDERS] = self.here();
        self.integers.extend(starts);
        let paths = paths_of_links(topology);
        let carries = |path: &[(usize, usize)], block: usize, place: usize| {
            path.iter().any(|&(other, count)| other == block && place < count)
        };
        let (mut first_impulse, mut pairs) = (topology.contacts.len(), Vec::new());
        for (number, pair) in topology.pairs.iter().enumerate() {
            let [first, second] = links_of(topology, pair);
            let bodies = pair.colliders.map(|c| topology.colliders[c].body);
            pairs.extend(pair.colliders.iter().chain(&bodies));
            let parts = pair.spans.len();
            pairs.extend([parts, topology.num_links() + number, first_impulse, self.here()]);
            first_impulse += parts;
            for (block, _) in path_of_both(&paths, [first, second]) {
                // links that a joint carries: 2 the first alone, 0 the second alone, 1 both
                for place in 0..3 {
                    let side = usize::from(carries(&paths[first], block, place)) + 1;
                    self.integers.push(side - usize::from(carries(&paths[second], block, place)));
                }
            }
        }
        header[PAIRS] = topology.pairs.len();
        header[T_PAIR] = self.here();
        self.integers.extend(pairs);
        let mut groups: Vec<[usize; 4]> = Vec::new();
        for (number, pair) in topology.pairs.iter().enumerate() {
            let [first, second] = links_of(topology, pair);
            match groups.last_mut() {
                Some([a, b, _, count]) if [*a, *b] == [first, second] => *count += 1,
                _ => groups.push([first, second, number, 1]),
            }
        }
        (header[GROUPS], header[COLLIDERS]) = (groups.len(), topology.colliders.len());
        header[T_GROUP] = self.here();
        self.integers.extend(groups.iter().flatten());
    }
}

/// Links of a pair of colliders.
fn links_of(topology: &Topology, pair: &PairTopology) -> [usize; 2] {
    pair.colliders.map(|c| topology.colliders[c].link)
}

/// Blocks that carry each link, the nearest first, with the number of their joints that do.
fn paths_of_links(topology: &Topology) -> Vec<Vec<(usize, usize)>> {
    let mut paths = vec![Vec::new(); topology.num_links()];
    for (b, block) in topology.blocks().iter().enumerate() {
        for place in 0..block.len {
            let carriers = topology.carriers_of(block).iter().map(|carrier| (carrier.block, carrier.count));
            paths[block.joints[place] + 1] = std::iter::once((b, place + 1)).chain(carriers).collect();
        }
    }
    paths
}

/// Blocks that carry one of two links or both, each before those that carry it.
fn path_of_both(paths: &[Vec<(usize, usize)>], links: [usize; 2]) -> Vec<(usize, usize)> {
    let mut path: Vec<(usize, usize)> = links.iter().flat_map(|&link| &paths[link]).copied().collect();
    // the larger count of a block that both paths have
    path.sort_unstable_by_key(|&part| std::cmp::Reverse(part));
    path.dedup_by_key(|part| part.0);
    path
}

/// Writes a height grid to the tables.
fn write_grid(heights: &Heights, header: &mut [usize], numbers: &mut [f32]) {
    header[HAS_GRID] = 1;
    header[GRID_SIZE..GRID_SIZE + 2].copy_from_slice(&heights.size);
    for (number, value) in [
        (GRID_ORIGIN, heights.origin[0]),
        (GRID_ORIGIN + 1, heights.origin[1]),
        (GRID_CELL, heights.cell),
        (GRID_INVERSE_CELL, (1.0 / f64::from(heights.cell)) as f32),
        (GRID_HIGHEST, heights.highest),
    ] {
        numbers[number] = value;
    }
    for (near, squares) in heights.squares.iter().enumerate() {
        let at = GRID_SQUARES + squares.len() * near;
        header[at..at + squares.len()].copy_from_slice(squares);
    }
}

/// Writes sizes and whole settings to the header.
fn sizes_and_settings(
    topology: &Topology,
    settings: &StepSettings,
    scene: &Scene,
    stride: usize,
    header: &mut [usize],
) {
    let (contact, solver) = (&settings.contact, &settings.contact.solver);
    let friction = match topology.friction {
        ContactFriction::Sliding => 0,
        ContactFriction::Torsional => 1,
        ContactFriction::Rolling => 2,
    };
    for (name, value) in [
        (FLOATING, usize::from(topology.floating)),
        (JOINTS, topology.num_joints()),
        (BLOCKS, topology.blocks().len()),
        (CONTACTS, topology.contacts.len()),
        (ROWS, num_rows(topology)),
        (SPINS, topology.num_impulses() - num_rows(topology)),
        (BODIES, topology.num_bodies),
        (SITES, topology.sites.len()),
        (STRIDE, stride),
        (FRICTION, friction),
        (HAS_SURFACES, usize::from(topology.has_surfaces)),
        (HAS_SPRINGS, usize::from(topology.has_springs)),
        (HAS_DELAY, usize::from(topology.has_delay)),
        (AGES, scene.ages.max(1)),
        (DECIMATION, settings.decimation),
        (ITERATIONS, contact.iterations),
        (MEASURES, usize::from(contact.iterations <= SWEEPS)),
        (CHECK_INTERVAL, solver.check_interval),
        (MAX_EXTRA_ROUNDS, solver.max_extra_rounds),
        (SWEEPS_PER_ROUND, solver.sweeps_per_round),
        (LIMIT_SWEEPS, solver.limit_sweeps),
        (PUSH_SWEEPS, solver.push_sweeps),
        (HAS_GROUND, usize::from(contact.ground.is_some())),
        (LINK_FORCES, scene.link_forces.len()),
    ] {
        header[name] = value;
    }
}

/// The most contacts at a time.
fn num_rows(topology: &Topology) -> usize {
    let pairs: usize = topology.pairs.iter().map(|pair| pair.spans.len()).sum();
    topology.contacts.len() + pairs
}

/// Settings in single precision, each rounded once as the kernels round it.
fn write_settings(settings: &StepSettings, numbers: &mut [f32]) {
    let (contact, solver) = (&settings.contact, &settings.contact.solver);
    let [x, y, z] = settings.gravity;
    let plane = contact.ground.unwrap_or(Plane::level(0.0));
    // Newmark's beta over his gamma: settings.rs of polypod-dynamics
    let look_ahead = 0.2;
    let [least, most] = solver.at_friction_bound;
    for (name, value) in [
        (DT, settings.dt),
        (GRAVITY, x),
        (GRAVITY + 1, y),
        (GRAVITY + 2, z),
        (LOOK_AHEAD, look_ahead),
        (IMPLICIT_STIFFNESS, (1.0 + look_ahead) * (1.0 + look_ahead) / 4.0),
        (SPRING_STIFFNESS, 0.25),
        (CORRECTION, contact.correction),
        (MAX_PUSH, contact.max_depenetration_velocity),
        (BOUNCE_SPEED, -contact.bounce_threshold),
        (GROUND_MARGIN, solver.ground_margin),
        (GROUND_REACH, solver.ground_reach),
        (PAIR_REACH, solver.pair_reach),
        (PAIR_ROUNDING, solver.pair_rounding),
        (LIMIT_REACH, solver.limit_reach),
        (MAX_LIMIT_REACH, solver.max_limit_reach),
        (VELOCITY_LIMIT_SHARE, solver.velocity_limit_share),
        (GROUND_COMPLIANCE, solver.ground_compliance),
        (PAIR_COMPLIANCE, solver.pair_compliance),
        (MIN_TANGENT_COMPLIANCE, solver.min_tangent_compliance),
        (PENETRATION_SLOP, solver.penetration_slop),
        (LIMIT_SLOP, solver.limit_slop),
        (MIN_CHANGE_SQUARED, solver.min_change * solver.min_change),
        (SETTLED_CHANGE, solver.settled_change),
        (DEEP_PUSH, solver.deep_push),
        (SETTLED_CHANGE_DEEP, solver.settled_change_deep),
        (LEAST_BOUND, least),
        (MOST_BOUND, most),
        (MIN_FOLLOWING_RESPONSE, solver.min_following_response),
        (TURN_BACK_SHARE, solver.turn_back_share),
        (LIMIT_TOLERANCE, solver.limit_tolerance),
        (PUSH_TOLERANCE, solver.push_tolerance),
        (PLANE_OFFSET, plane.offset),
    ] {
        numbers[name] = value as f32;
    }
    for (number, axis) in numbers[PLANE..].iter_mut().zip(plane_frame(&plane).as_flattened()) {
        *number = *axis as f32;
    }
}

/// Normal and tangents of a plane, world axes, as `polypod-dynamics` has them.
fn plane_frame(plane: &Plane) -> [[f64; 3]; 3] {
    let n = plane.normal;
    if n == [0.0, 0.0, 1.0] {
        return [n, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    }
    let along = if n[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let t = add_scaled(&along, &n, -dot(&along, &n));
    let t = scale(&t, 1.0 / dot(&t, &t).sqrt());
    [n, t, cross(&n, &t)]
}

/// Places of the columns: of the parameters in the order in which they are visited, of state,
/// drive, report and workspace.
fn place_columns(
    topology: &Topology,
    settings: &StepSettings,
    scene: &Scene,
    stride: usize,
    header: &mut [usize],
) -> Sizes {
    let (joints, links, blocks) = (topology.num_joints(), topology.num_links(), topology.blocks().len());
    let (contacts, bodies, sites) = (topology.contacts.len(), topology.num_bodies, topology.sites.len());
    let (rows, colliders) = (num_rows(topology), topology.colliders.len());
    let impulses = topology.num_impulses();
    let spins = impulses - rows;
    let trees = header[TREES];
    let has_networks = usize::from(!scene.networks.is_empty());
    let features = num_features(scene.networks);
    let couplings = topology.blocks().iter().map(|block| block.num_carriers).sum::<usize>();
    let mut columns = |lists: &[(usize, usize)]| {
        let mut places = Places { integers: header, next: 0 };
        for &(name, len) in lists {
            places.list(name, len);
        }
        places.next
    };
    let parameters = columns(&[
        (P_OFFSET, 3 * joints),
        (P_MASS, links),
        (P_COM, 3 * links),
        (P_INERTIA, 6 * links),
        (P_STIFFNESS, joints),
        (P_DAMPING, joints),
        (P_EFFORT_LIMIT, joints),
        (P_SATURATION_EFFORT, joints),
        (P_MOTOR_VELOCITY_LIMIT, joints),
        (P_ARMATURE, joints),
        (P_JOINT_DAMPING, joints),
        (P_JOINT_FRICTION, joints),
        (P_SPRING, if topology.has_springs { 2 * joints } else { 0 }),
        (P_LOWER, joints),
        (P_UPPER, joints),
        (P_VELOCITY_LIMIT, joints),
        (P_CONTACT_POSITION, 3 * contacts),
        (P_CONTACT_RADIUS, contacts),
        (P_CONTACT_RIM, contacts),
        (P_CONTACT_FRICTION, if topology.has_surfaces { 3 * contacts } else { 0 }),
        (P_LINK_BOX, 6 * links),
        (P_COLLIDER_CENTRE, 3 * colliders),
        (P_COLLIDER_HALF, 3 * colliders),
        (P_COLLIDER_RADIUS, colliders),
        (P_SITE_POSITION, 3 * sites),
        (P_STATIC_FRICTION, 1),
        (P_DYNAMIC_FRICTION, 1),
        (P_RESTITUTION, 1),
        (P_TORSIONAL_FRICTION, 1),
        (P_ROLLING_FRICTION, 1),
    ]);
    let state = columns(&[
        (S_POSITION, 3),
        (S_ROTATION, 4),
        (S_LINEAR, 3),
        (S_ANGULAR, 3),
        (S_JOINT, joints),
        (S_JOINT_VELOCITY, joints),
        (S_BOUND, joints),
        (S_MEMORY, ActuatorNetwork::num_remembered_by(scene.networks)),
        (S_PRESSING, 1),
    ]);
    let drive = columns(&[
        (D_TARGET, scene.ages.max(1) * joints),
        (D_DELAY, joints),
        (D_FEEDFORWARD, joints),
        (D_FORCE, 3),
        (D_TORQUE, 3),
        (D_ORIGIN, 2),
        (D_LINK_FORCE, LINK_FORCE_SIZE * scene.link_forces.len()),
    ]);
    let report = columns(&[
        (R_EFFORT, joints),
        (R_ACCELERATION, joints),
        (R_BODY_FORCE, 3 * bodies),
        (R_NORMAL_FORCE, settings.decimation * bodies),
        (R_SITE_POSITION, 3 * sites),
        (R_SITE_VELOCITY, 3 * sites),
    ]);
    let work = columns(&[
        (W_LINK, LINK_SIZE * links),
        (W_DYNAMICS, DYNAMICS_SIZE * links),
        (W_BIAS, joints),
        (W_FACTOR, FACTOR_SIZE * blocks),
        (W_COUPLING, 9 * couplings),
        (W_ROOT, 6 * blocks),
        (W_RHS, 3 * blocks),
        (W_EFFORT, joints),
        (W_SLOPE, joints),
        (W_TARGET, joints),
        (W_JOINTS, 3 * blocks.max(1)),
        (W_MOVED, 3 * blocks.max(1)),
        (W_ROW, ROW_SIZE * rows),
        (W_FURTHER, 9 * stride * rows),
        (W_SPIN, SPIN_SIZE * spins),
        (W_SPIN_FURTHER, 9 * stride * spins),
        (W_BOUND, BOUND_SIZE * blocks),
        (W_BOUND_FURTHER, 9 * stride * blocks),
        (W_COLLIDER, PLACED_SIZE * colliders),
        (W_LINK_BOX, LINK_BOX_SIZE * links),
        (W_PRESSING, 3 * impulses),
        (W_DEMANDS, bodies + blocks + 1),
        (W_STATE, state),
        (W_TREE, TREE_SIZE * trees),
        (W_GROUND, GROUND_SIZE * links),
        (W_FOUND, FOUND_SIZE * rows),
        (W_DRIVEN, has_networks * joints),
        (W_UNBOUNDED, has_networks),
        (W_FEATURES, features / TILE_OF_HOST),
    ]);
    let work_integers = columns(&[
        (I_ROW, ROW_INTEGERS * rows),
        (I_BOUND, BOUND_INTEGERS * blocks),
        (I_PLACED, links),
        (I_PRESSING, 1 + impulses),
        (I_TOUCHED, bodies),
        (I_NEXT, rows),
        (I_NEXT_PAIR, topology.pairs.len() + rows - contacts),
    ]);
    Sizes { parameters, state, drive, report, work, work_integers, features, impulses }
}

//! Finding robots, tasks and training configs: in folders laid out like this repository, then among
//! those compiled in.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use include_dir::{Dir, include_dir};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::document::{Document, DocumentKind, documents, documents_named, is_toml, stem_of, unreadable};
use super::error::{ConfigError, ConfigErrorKind};
use super::layer::{EXTENDS, IDENTITY, Layer, Layers, parse, string_key, string_list};
use super::names::{RobotEntry, TaskEntry, TaskNames, TrainEntry, single_robot_name, task_names, unknown_name};
use super::play;
use super::robot::RobotConfig;
use super::scene::embed_meshes;
use super::suggest::did_you_mean;
use super::task::TaskConfig;
use crate::actuator_network;
use crate::files;
use crate::hash::fnv1a;
use crate::robot::CANONICAL_JOINT_NAMES;

/// Environment variable with further roots, separated as in `PATH`.
pub const PATH_VARIABLE: &str = "POLYPOD_PATH";

/// Prefix of the names of Isaac Lab's tasks.
const ISAAC_LAB: &str = "Isaac-";

static ROBOT_ASSETS: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/assets/robots");

/// All configs that can be named.
#[derive(Clone, Debug, Default)]
pub struct Library {
    roots: Vec<PathBuf>,
}

/// A robot's config with the URDF it names.
#[derive(Clone, Debug)]
pub struct LoadedRobot {
    /// The config, checked.
    pub config: RobotConfig,
    /// The text of the URDF.
    pub urdf_text: String,
    /// Path of the URDF; for a built-in robot its path within the repository.
    pub urdf_path: PathBuf,
    /// The files of its actuator networks, by group.
    pub networks: BTreeMap<String, NetworkFile>,
    /// The config with all layers and defaults spelled out.
    pub resolved: Table,
    /// The files of the config.
    pub(crate) layers: Layers,
}

impl LoadedRobot {
    /// The same error, blamed on the file that sets its element.
    pub(crate) fn blame(&self, error: ConfigError) -> ConfigError {
        self.layers.locate(error, &[])
    }
}

/// A file of an actuator network.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct NetworkFile {
    /// Path of the file; for a built-in one its path within the repository.
    pub path: PathBuf,
    /// Content of the file.
    pub bytes: Vec<u8>,
}

impl NetworkFile {
    /// FNV-1a as configs state it.
    #[must_use]
    pub fn checksum(&self) -> String {
        format!("{:016x}", fnv1a(&self.bytes))
    }
}

/// A task's config.
#[derive(Clone, Debug)]
pub struct LoadedTask {
    /// The config, checked.
    pub config: TaskConfig,
    /// The config with all layers, overrides and defaults spelled out.
    pub resolved: Table,
    /// FNV-1a of `resolved` as text: the same config has the same hash on every machine.
    pub hash: u64,
}

/// A config and where it comes from.
#[derive(Clone, Debug)]
pub struct Explained {
    /// Files of the config with the table of each, the one that extends no other first.
    pub layers: Vec<(String, Table)>,
    /// All layers, overrides and defaults in one table.
    pub resolved: Table,
}

/// A training config, read but not parsed.
#[derive(Clone, Debug)]
pub struct TrainFile {
    /// Text of the file, TOML.
    pub text: String,
    /// Identity of the file, however its path is written.
    pub id: PathBuf,
    /// Folder of the file, where relative paths begin; None for a built-in file.
    pub folder: Option<PathBuf>,
}

impl Library {
    /// A library of the roots `extra`, then those of the environment variable [`PATH_VARIABLE`],
    /// then the built-in configs. The first root wins. A root is laid out like this repository:
    /// `configs/robots`, `configs/tasks`, `assets/robots`.
    #[must_use]
    pub fn new(extra: Vec<PathBuf>) -> Self {
        let from_env = std::env::var_os(PATH_VARIABLE).unwrap_or_default();
        let from_env = std::env::split_paths(&from_env).filter(|root| !root.as_os_str().is_empty());
        Self { roots: extra.into_iter().chain(from_env).collect() }
    }

    /// The robot of that name, or of that path to a `.toml`.
    ///
    /// # Errors
    /// Unknown name, unreadable file, any mistake in the config, no URDF.
    pub fn robot(&self, name_or_path: &str) -> Result<LoadedRobot, ConfigError> {
        self.robot_with(name_or_path, None)
    }

    /// A robot in a task: with the task's `[robot_overrides]` on top.
    ///
    /// # Errors
    /// As [`Library::robots_in`].
    pub fn robot_in(&self, name_or_path: &str, task: &TaskConfig) -> Result<LoadedRobot, ConfigError> {
        self.check_overrides(std::slice::from_ref(&name_or_path.to_owned()), task)?;
        self.robot_with(name_or_path, Some(task))
    }

    /// Robots, by name or path, for a task: with the task's `[robot_overrides]` on top, by name or
    /// by a path's stem.
    ///
    /// # Errors
    /// As [`Library::robot`]; overrides or shares of a robot that does not exist.
    pub fn robots_in(&self, names_or_paths: &[String], task: &TaskConfig) -> Result<Vec<LoadedRobot>, ConfigError> {
        self.check_overrides(names_or_paths, task)?;
        names_or_paths.iter().map(|name| self.robot_with(name, Some(task))).collect()
    }

    fn check_overrides(&self, names_or_paths: &[String], task: &TaskConfig) -> Result<(), ConfigError> {
        if task.robot_overrides.is_empty() && task.env_shares.is_empty() {
            return Ok(());
        }
        let mut named = (task.robot_overrides.keys().map(|name| ("robot_overrides", name)))
            .chain(task.env_shares.keys().map(|name| ("env_shares", name)));
        let mut known: Vec<String> =
            self.listed(DocumentKind::Robot)?.into_iter().map(|document| document.stem).collect();
        known.extend(task.robots.iter().chain(names_or_paths).map(|name| match Path::new(name) {
            path if is_toml(path) => stem_of(path),
            _ => name.clone(),
        }));
        if let Some((table, stranger)) = named.find(|(_, name)| !known.contains(*name)) {
            let element = format!("{table}.{stranger}");
            let remedy = did_you_mean(stranger, known.iter().map(String::as_str), "robots");
            let error =
                ConfigError::invalid(task.name.clone(), element, format!("there is no robot `{stranger}`"), remedy);
            return Err(error.of_kind(ConfigErrorKind::UnknownName));
        }
        Ok(())
    }

    fn robot_with(&self, name_or_path: &str, task: Option<&TaskConfig>) -> Result<LoadedRobot, ConfigError> {
        let top = self.find(DocumentKind::Robot, name_or_path, None, &[])?;
        let mut document = top.clone();
        let mut layers = self.layers(DocumentKind::Robot, top)?;
        if let Some((task, changes)) = task.and_then(|task| Some((task, task.robot_overrides.get(&document.stem)?))) {
            // keys that tell one robot from another are never inherited, and a task does not make
            // another robot
            let own = layers.0.last().into_iter().flat_map(|layer| &layer.table);
            let mut table: Table = own
                .filter(|(key, _)| IDENTITY.contains(&key.as_str()))
                .map(|(key, value)| (key.clone(), value.clone()))
                .collect();
            table.extend(changes.clone());
            document.file = format!("{}: robot_overrides.{}", task.name, document.stem);
            layers.0.push(Layer { document, table });
        }
        layers.0.iter_mut().for_each(make_package_dirs_absolute);
        let (mut config, mut resolved) = layers.typed(&[], RobotConfig::validate)?;
        let stem = layers.0.last().map_or("", |layer| layer.document.stem.as_str());
        if config.name != stem {
            let error = ConfigError::invalid(
                "",
                "name",
                format!("the name `{}` is not the file's", config.name),
                format!("write name = \"{stem}\", or rename the file"),
            );
            return Err(layers.locate(error, &[]));
        }
        let (urdf_path, urdf) = self.beside(&layers, "urdf", &config.urdf, files::MAX_BYTES)?;
        let urdf_text = String::from_utf8(urdf)
            .map_err(|_| unreadable(&urdf_path.display().to_string(), "cannot be read: it is not UTF-8".into()))?;
        let networks = self.networks(&layers, &mut config, &mut resolved)?;
        Ok(LoadedRobot { config, urdf_text, urdf_path, networks, resolved, layers })
    }

    /// Reads the files of actuator networks, and states their checksums in the config.
    fn networks(
        &self,
        layers: &Layers,
        config: &mut RobotConfig,
        resolved: &mut Table,
    ) -> Result<BTreeMap<String, NetworkFile>, ConfigError> {
        let mut networks = BTreeMap::new();
        for (group, actuator) in &mut config.actuators {
            let Some(name) = &actuator.network_file else { continue };
            let (path, bytes) =
                self.beside(layers, &format!("actuators.{group}.network_file"), name, actuator_network::MAX_BYTES)?;
            let file = NetworkFile { path, bytes };
            let found = file.checksum();
            if let Some(stated) = actuator.network_checksum.replace(found.clone()).filter(|stated| *stated != found) {
                let problem = format!("is {stated}, and {} has {found}", file.path.display());
                let remedy = "pass the file that the robot had then, or remove the key";
                let error = ConfigError::invalid("", format!("actuators.{group}.network_checksum"), problem, remedy);
                return Err(layers.locate(error, &[]));
            }
            let table = resolved.get_mut("actuators").and_then(|groups| groups.get_mut(group.as_str()));
            if let Some(Value::Table(table)) = table {
                table.insert("network_checksum".into(), found.into());
            }
            networks.insert(group.clone(), file);
        }
        Ok(networks)
    }

    /// The task of that name, alias or file stem, or of that path to a `.toml`; then `overrides`,
    /// each `key=value`, in order. Isaac Lab's prefix `Isaac-` before a name that nothing else has
    /// is left out. The Play variant of a task that has no file for one is made, see
    /// [`Library::play_task`].
    ///
    /// # Errors
    /// Unknown name, unreadable file, any mistake in the config or in an override.
    pub fn task(&self, name: &str, overrides: &[String]) -> Result<LoadedTask, ConfigError> {
        let mut layers = self.layers_of_task(name)?;
        for layer in &mut layers.0 {
            let dir = layer.document.dir.clone().unwrap_or_default();
            embed_meshes(&mut layer.table, &dir).map_err(|error| error.in_file(layer.document.file.clone()))?;
        }
        let (config, resolved) = layers.typed(overrides, TaskConfig::validate)?;
        let hash = fnv1a(resolved.to_string().as_bytes());
        Ok(LoadedTask { config, resolved, hash })
    }

    /// A task as [`Library::task`] reads it, with the files that it comes from.
    ///
    /// # Errors
    /// As [`Library::task`].
    pub fn explain_task(&self, name: &str, overrides: &[String]) -> Result<Explained, ConfigError> {
        let resolved = self.task(name, overrides)?.resolved;
        Ok(Explained { layers: self.layers_of_task(name)?.named(), resolved })
    }

    /// A robot's config with the files that it comes from.
    ///
    /// # Errors
    /// As [`Library::robot`].
    pub fn explain_robot(&self, name: &str) -> Result<Explained, ConfigError> {
        let LoadedRobot { layers, resolved, .. } = self.robot(name)?;
        Ok(Explained { layers: layers.named(), resolved })
    }

    /// The name of the Play variant of a task, for [`Library::task`]: without noise, pushes,
    /// randomisation and curriculum. It is the one that has a file, or else one that is made. A
    /// Play variant is its own.
    ///
    /// # Errors
    /// Unknown name, unreadable file.
    pub fn play_task(&self, name: &str) -> Result<String, ConfigError> {
        let layers = self.layers_of_task(name)?;
        Ok(play::play_name(&if is_toml(Path::new(name)) { name.to_owned() } else { full_name(&layers)? }))
    }

    /// The task that a Play variant belongs to; the task itself where it is no Play variant, or
    /// where there is no such task.
    ///
    /// # Errors
    /// Unknown name, unreadable file.
    pub fn training_task(&self, name: &str) -> Result<String, ConfigError> {
        let layers = self.layers_of_task(name)?;
        let full = if is_toml(Path::new(name)) { name.to_owned() } else { full_name(&layers)? };
        let Some(training) = play::training_name(&full) else { return Ok(full) };
        match self.layers_of_task(&training) {
            Ok(_) => Ok(training),
            Err(_) => Ok(full),
        }
    }

    /// The file `configs/train/<name>.toml`, or that of a path to a `.toml`, that is not among the
    /// files `above` by their ids: a file may extend the one of the same name that it hides.
    ///
    /// # Errors
    /// Unknown name, unreadable file, a file that extends itself.
    pub fn train(&self, name: &str, above: &[PathBuf]) -> Result<TrainFile, ConfigError> {
        let above: Vec<_> = above.iter().map(|id| (id.clone(), id.display().to_string())).collect();
        let document = self.find(DocumentKind::Train, name, None, &above)?;
        Ok(TrainFile { text: document.text?, id: document.id, folder: document.dir })
    }

    /// All training configs, by name, but for those that cannot be read.
    ///
    /// # Errors
    /// A root that is no folder, an unreadable folder.
    pub fn train_configs(&self) -> Result<Vec<TrainEntry>, ConfigError> {
        let entry = |document: Document| {
            let first = document
                .text
                .ok()?
                .lines()
                .next()
                .and_then(|line| line.strip_prefix('#'))
                .unwrap_or("")
                .trim()
                .to_owned();
            Some(TrainEntry { name: document.stem, file: document.file, title: first })
        };
        let mut configs: Vec<_> = self.listed(DocumentKind::Train)?.into_iter().filter_map(entry).collect();
        configs.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(configs)
    }

    /// All robots, by name, but for those of [`Library::broken`].
    ///
    /// # Errors
    /// A root that is no folder, an unreadable folder.
    pub fn robots(&self) -> Result<Vec<RobotEntry>, ConfigError> {
        let mut robots: Vec<_> =
            self.listed(DocumentKind::Robot)?.into_iter().flat_map(|document| self.robot_entry(document)).collect();
        robots.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(robots)
    }

    /// All tasks but for those of [`Library::broken`]: those with a file, then those made for one
    /// robot.
    ///
    /// # Errors
    /// A root that is no folder, an unreadable folder.
    pub fn tasks(&self) -> Result<Vec<TaskEntry>, ConfigError> {
        let mut tasks: Vec<_> =
            self.listed(DocumentKind::Task)?.into_iter().flat_map(|document| self.task_entry(document)).collect();
        tasks.sort_by(|a, b| a.name.cmp(&b.name));
        let mut single = Vec::new();
        for robot in self.robots()? {
            single.extend(tasks.iter().filter_map(|task| {
                let name = single_robot_name(&task.name, &robot.name, robot.is_quadruped)?;
                Some(TaskEntry { name, aliases: Vec::new(), file: task.file.clone(), robots: vec![robot.name.clone()] })
            }));
        }
        single.retain(|made| tasks.iter().all(|task| task.name != made.name));
        tasks.extend(single);
        Ok(tasks)
    }

    /// Files that [`Library::robots`] and [`Library::tasks`] leave out: the errors of files that
    /// cannot be read, are not TOML or extend what cannot be extended. Using one of their names
    /// gives the same error.
    ///
    /// # Errors
    /// A root that is no folder, an unreadable folder.
    pub fn broken(&self) -> Result<Vec<ConfigError>, ConfigError> {
        let robots =
            self.listed(DocumentKind::Robot)?.into_iter().filter_map(|document| self.robot_entry(document).err());
        let tasks = self.listed(DocumentKind::Task)?.into_iter().filter_map(|document| self.task_entry(document).err());
        let mut broken: Vec<ConfigError> = Vec::new();
        for error in robots.chain(tasks) {
            // tasks that extend a broken one share its error
            if !broken.contains(&error) {
                broken.push(error);
            }
        }
        Ok(broken)
    }

    fn robot_entry(&self, document: Document) -> Result<RobotEntry, ConfigError> {
        let table = parse(&document)?;
        let title = string_key(&document, &table, "title")?.unwrap_or(&document.stem).to_owned();
        let (name, file) = (document.stem.clone(), document.file.clone());
        // an error in a layer is reported where the robot is used
        let merged = self.layers(DocumentKind::Robot, document).and_then(|layers| layers.merged()).unwrap_or_default();
        let pose = merged.get("default_pose").and_then(Value::as_table).into_iter().flatten();
        let is_quadruped = pose.into_iter().all(|(joint, _)| CANONICAL_JOINT_NAMES.contains(&joint.as_str()));
        let needs_policy = merged.get("needs_policy").and_then(Value::as_str).map(str::to_owned);
        Ok(RobotEntry { name, title, file, is_quadruped, needs_policy })
    }

    fn task_entry(&self, document: Document) -> Result<TaskEntry, ConfigError> {
        let TaskNames { name, aliases } = task_names(&document)?;
        let file = document.file.clone();
        let merged = self.layers(DocumentKind::Task, document)?.merged()?;
        let robots = merged.get("robots").and_then(Value::as_array).into_iter().flatten();
        let robots = robots.filter_map(Value::as_str).map(str::to_owned).collect();
        Ok(TaskEntry { name, aliases, file, robots })
    }

    /// The layers of a task by one of its names, which may begin as Isaac Lab's do.
    fn layers_of_task(&self, name: &str) -> Result<Layers, ConfigError> {
        match (self.task_layers(name), name.strip_prefix(ISAAC_LAB)) {
            (Err(error), Some(own)) if error.kind == ConfigErrorKind::UnknownName => {
                self.task_layers(own).map_err(|_| error)
            }
            (layers, _) => layers,
        }
    }

    /// The layers of a task by one of its names.
    fn task_layers(&self, name: &str) -> Result<Layers, ConfigError> {
        if is_toml(Path::new(name)) && !Path::new(name).exists() {
            // errors name the given name, not the one that it leads to
            let found =
                self.find(DocumentKind::Task, name, None, &[]).and_then(|top| self.layers(DocumentKind::Task, top));
            return found.or_else(|error| self.play_layers(name)?.ok_or(error));
        }
        match self.find(DocumentKind::Task, name, None, &[]) {
            Ok(top) => self.layers(DocumentKind::Task, top),
            Err(error) if error.kind == ConfigErrorKind::UnknownName => {
                let made = match self.single_robot_layers(name)? {
                    Some(layers) => Some(layers),
                    None => self.play_layers(name)?,
                };
                made.ok_or(error)
            }
            Err(error) => Err(error),
        }
    }

    /// The layers of the Play variant `name`, if it is one of a task that has no file for it.
    fn play_layers(&self, name: &str) -> Result<Option<Layers>, ConfigError> {
        let Some(training) = play::training_name(name) else {
            return Ok(None);
        };
        let mut layers = match self.task_layers(&training) {
            Ok(layers) => layers,
            Err(error) if error.kind == ConfigErrorKind::UnknownName => return Ok(None),
            Err(_) if is_toml(Path::new(&training)) && !Path::new(&training).exists() => return Ok(None),
            Err(error) => return Err(error),
        };
        let full = play::play_name(&full_name(&layers)?);
        let table = play::changes(&full, &layers.merged()?);
        if let Some(layer) = layers.0.last() {
            let document = layer.document.clone();
            layers.0.push(Layer { document, table });
        }
        Ok(Some(layers))
    }

    /// The layers of the task `name`, if it is one made for one robot.
    fn single_robot_layers(&self, name: &str) -> Result<Option<Layers>, ConfigError> {
        let robots = self.robots()?;
        for base in self.listed(DocumentKind::Task)? {
            let Ok(TaskNames { name: base_name, .. }) = task_names(&base) else {
                continue;
            };
            let of_robot = |robot: &&RobotEntry| {
                single_robot_name(&base_name, &robot.name, robot.is_quadruped).is_some_and(|made| made == name)
            };
            let Some(robot) = robots.iter().find(of_robot) else {
                continue;
            };
            let document = base.clone();
            let mut layers = self.layers(DocumentKind::Task, base)?;
            let mut table = Table::new();
            table.insert("name".into(), name.into());
            table.insert("robots".into(), Value::Array(vec![robot.name.clone().into()]));
            if let Some(Value::String(experiment)) = layers.merged()?.get("experiment_name") {
                let experiment = format!("{experiment}_{}", robot.name);
                table.insert("experiment_name".into(), experiment.into());
            }
            layers.0.push(Layer { document, table });
            return Ok(Some(layers));
        }
        Ok(None)
    }

    /// `top` and all that it extends.
    fn layers(&self, kind: DocumentKind, top: Document) -> Result<Layers, ConfigError> {
        let mut layers = Vec::new();
        self.add_layers(kind, top, &mut Vec::new(), &mut layers)?;
        Ok(Layers(layers))
    }

    /// Adds what a file extends, then the file; what is there already stays where it is. `path` are
    /// the files above it.
    fn add_layers(
        &self,
        kind: DocumentKind,
        document: Document,
        path: &mut Vec<(PathBuf, String)>,
        layers: &mut Vec<Layer>,
    ) -> Result<(), ConfigError> {
        let table = parse(&document)?;
        path.push((document.id.clone(), document.file.clone()));
        for base in string_list(&document, &table, EXTENDS)? {
            let base = self.find(kind, base, document.dir.as_deref(), path).map_err(|error| ConfigError {
                file: document.file.clone(),
                element: EXTENDS.into(),
                ..error
            })?;
            if layers.iter().all(|layer| layer.document.id != base.id) {
                self.add_layers(kind, base, path, layers)?;
            }
        }
        path.pop();
        layers.push(Layer { document, table });
        Ok(())
    }

    /// The first config called `name` that is not among the files `visited`, so that a root may
    /// extend what it hides. A name that ends in `.toml` is a path, relative to `dir` or else to
    /// the working directory.
    fn find(
        &self,
        kind: DocumentKind,
        name: &str,
        dir: Option<&Path>,
        visited: &[(PathBuf, String)],
    ) -> Result<Document, ConfigError> {
        let cycle = || {
            let files: Vec<&str> = visited.iter().map(|(_, file)| file.as_str()).collect();
            ConfigError::invalid(
                name,
                EXTENDS,
                format!("`{name}` extends itself: {}", files.join(" -> ")),
                "break the circle",
            )
        };
        let is_free = |document: &Document| visited.iter().all(|(id, _)| *id != document.id);
        if is_toml(Path::new(name)) {
            let document = Document::read(&dir.unwrap_or(Path::new("")).join(name), None);
            document.text()?;
            return if is_free(&document) { Ok(document) } else { Err(cycle()) };
        }
        // most names are file names: a large library need not be read for one of them
        let named = documents_named(kind, &self.roots, name)?;
        if let Some(document) = named.iter().find(|document| is_free(document)) {
            return Ok(document.clone());
        }
        let documents = documents(kind, &self.roots)?;
        let mut matching: Vec<&Document> = documents.iter().filter(|d| d.stem == name).collect();
        let mut known: Vec<String> = documents.iter().map(|d| d.stem.clone()).collect();
        let mut broken = Vec::new();
        // other files are parsed only if no stem decides, and a broken one does not stand in the
        // way
        if matches!(kind, DocumentKind::Task) && !matching.iter().any(|document| is_free(document)) {
            for document in &documents {
                let TaskNames { name: full, aliases } = match task_names(document) {
                    Ok(names) => names,
                    Err(error) => {
                        broken.push(error);
                        continue;
                    }
                };
                if full == name || aliases.iter().any(|alias| alias == name) {
                    matching.push(document);
                }
                known.push(full);
                known.extend(aliases);
            }
        }
        if let Some(document) = matching.iter().find(|document| is_free(document)) {
            return Ok((*document).clone());
        }
        if !matching.is_empty() {
            return Err(cycle());
        }
        known.sort();
        known.dedup();
        let robots = match kind {
            DocumentKind::Task => self.robots()?,
            DocumentKind::Robot | DocumentKind::Train => Vec::new(),
        };
        let made: Vec<String> = robots
            .iter()
            .flat_map(|robot| known.iter().filter_map(|task| single_robot_name(task, &robot.name, robot.is_quadruped)))
            .collect();
        Err(unknown_name(kind, name, &known, &made, &broken))
    }

    /// The configs of a kind that a name can reach: of those with the same stem only the first.
    fn listed(&self, kind: DocumentKind) -> Result<Vec<Document>, ConfigError> {
        let mut listed: Vec<Document> = Vec::new();
        for document in documents(kind, &self.roots)? {
            if listed.iter().all(|earlier| earlier.stem != document.stem) {
                listed.push(document);
            }
        }
        Ok(listed)
    }

    /// Path and content of a file that a robot's config names: next to the configs, in their roots,
    /// in the library's roots, among the built-in assets.
    fn beside(
        &self,
        layers: &Layers,
        element: &str,
        file: &Path,
        most: u64,
    ) -> Result<(PathBuf, Vec<u8>), ConfigError> {
        let beside = layers
            .0
            .iter()
            .rev()
            .flat_map(|layer| [layer.document.dir.as_ref(), layer.document.root.as_ref()].into_iter().flatten());
        let mut tried = Vec::new();
        for folder in beside.chain(&self.roots) {
            let path = folder.join(file);
            if path.is_file() {
                let bytes = files::read_up_to(&path, most)
                    .map_err(|error| unreadable(&path.display().to_string(), format!("cannot be read: {error}")))?;
                return Ok((path, bytes));
            }
            let path = path.display().to_string();
            if !tried.contains(&path) {
                tried.push(path);
            }
        }
        let built_in = file.strip_prefix("assets/robots").ok().and_then(|path| ROBOT_ASSETS.get_file(path));
        if let Some(built_in) = built_in {
            return Ok((file.to_owned(), built_in.contents().to_vec()));
        }
        tried.push(format!("{} (built in)", file.display()));
        let error = ConfigError::invalid(
            "",
            element,
            format!("there is no such file; tried {}", tried.join(", ")),
            "write a path relative to this file or to the root that holds configs/ and assets/",
        );
        Err(layers.locate(error.of_kind(ConfigErrorKind::Unreadable), &[]))
    }
}

/// The full name of a task.
fn full_name(layers: &Layers) -> Result<String, ConfigError> {
    let merged = layers.merged()?;
    let stem = || layers.0.last().map_or_else(String::new, |layer| layer.document.stem.clone());
    Ok(merged.get("name").and_then(Value::as_str).map_or_else(stem, str::to_owned))
}

/// Relative package folders are meant from the folder of the file that names them.
fn make_package_dirs_absolute(layer: &mut Layer) {
    let Some(dir) = &layer.document.dir else {
        return;
    };
    if let Some(Value::Table(packages)) = layer.table.get_mut("package_dirs") {
        for (_, folder) in packages.iter_mut() {
            if let Value::String(path) = folder {
                *path = dir.join(&*path).display().to_string();
            }
        }
    }
}

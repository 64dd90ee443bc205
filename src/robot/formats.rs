//! Files that are no URDF: their formats, and remedies.

/// Name of a format and the remedy for a file in it; `None` where the bytes tell nothing.
pub(super) fn recognised(bytes: &[u8]) -> Option<(&'static str, &'static str)> {
    const EXPORT_USD: &str = "export the robot as URDF: Isaac Sim and USD tools can write one";
    const NAME_URDF: &str = "name the robot's URDF file";
    const NAME_MESH: &str = "name the URDF that uses this mesh";
    let begins = |magic: &[u8]| bytes.starts_with(magic);
    let has = |word: &[u8]| bytes[..bytes.len().min(4096)].windows(word.len()).any(|window| window == word);
    Some(match () {
        () if begins(b"PXR-USDC") => ("a binary USD file (.usd, .usdc)", EXPORT_USD),
        () if begins(b"#usda") => ("a USD file (.usd, .usda)", EXPORT_USD),
        () if begins(b"PK\x03\x04") && (has(b".usdc") || has(b".usda") || has(b".usd")) => {
            ("a USD archive (.usdz)", EXPORT_USD)
        }
        () if begins(b"PK\x03\x04") || begins(b"PK\x05\x06") => ("a zip archive", "unpack it and name the URDF in it"),
        () if begins(b"\x1f\x8b") => ("a gzip archive", "unpack it and name the URDF in it"),
        () if begins(b"BZh")
            || begins(b"\xfd7zXZ")
            || begins(b"7z\xbc\xaf")
            || begins(b"Rar!")
            || begins(b"\x28\xb5\x2f\xfd") =>
        {
            ("an archive", "unpack it and name the URDF in it")
        }
        () if begins(b"%PDF") => ("a PDF document", NAME_URDF),
        () if begins(b"\x89PNG") || begins(b"\xff\xd8\xff") || begins(b"GIF8") => ("a picture", NAME_URDF),
        () if begins(b"\x7fELF") || begins(b"MZ") => ("a program", NAME_URDF),
        () if begins(b"\x89HDF") => ("an HDF5 file", NAME_URDF),
        () if begins(b"MJB") => ("a compiled MuJoCo model", "export the robot as URDF"),
        () if begins(b"glTF") => ("a glTF mesh", NAME_MESH),
        () if begins(b"solid ") => ("an STL mesh", NAME_MESH),
        () if begins(b"ISO-10303-21") => ("a STEP file", "export the robot from CAD as URDF"),
        () if begins(b"# Blender") || begins(b"v ") || begins(b"mtllib ") => ("an OBJ mesh", NAME_MESH),
        () if begins(b"ply\n") || begins(b"ply\r") => ("a PLY mesh", NAME_MESH),
        () if begins(b"version https://git-lfs") => ("a pointer of Git LFS", "fetch the file: `git lfs pull`"),
        () if begins(b"{") => ("a JSON file", NAME_URDF),
        () if begins(b"[") && !has(b"<robot") => ("a TOML or JSON file", NAME_URDF),
        () => return None,
    })
}

/// Format of a document whose root element is not `<robot>`, by that element.
pub(super) fn of_root(tag: &str) -> String {
    match tag {
        "mujoco" => "this is a MuJoCo (MJCF, mujoco) file: `polypod add` takes it, or export the robot as URDF".to_string(),
        "mujocoinclude" => "this is a part of a MuJoCo (MJCF) file: export the robot as URDF".to_string(),
        "sdf" | "gazebo" => "this is an SDF (sdf) file: export the robot as URDF".to_string(),
        "COLLADA" => "this is a COLLADA mesh: name the URDF that uses it".to_string(),
        "package" => "this is a ROS package manifest: name the URDF in the package".to_string(),
        "launch" => "this is a ROS launch file: name the URDF that it loads".to_string(),
        "html" | "HTML" => "this is a web page: download the file itself".to_string(),
        "svg" => "this is a picture: name the robot's URDF file".to_string(),
        "link" | "joint" | "model" => "put everything inside <robot>, or name a URDF file".to_string(),
        _ => "name a URDF file".to_string(),
    }
}

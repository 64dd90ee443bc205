//! Input: a policy's manifest; after a zero byte, if there is one, its ONNX graph.

use std::path::Path;

use polypod_sim::policy::{Policy, PolicyManifest, sha256};

/// A linear policy of 3 observations and 2 actions.
const GRAPH: &[u8] = include_bytes!("linear.onnx");

/// Loads the policy, without running it.
pub fn run(data: &[u8]) -> bool {
    let end = data.iter().position(|byte| *byte == 0);
    let (manifest, graph) = end.map_or((data, GRAPH), |end| (&data[..end], &data[end + 1..]));
    let Ok(text) = std::str::from_utf8(manifest) else {
        return false;
    };
    let file = Path::new("policy.onnx");
    let loaded = PolicyManifest::parse(text, file).and_then(|mut manifest| {
        // the fuzzer does not guess a checksum
        manifest.files.insert("policy.onnx".into(), sha256(graph));
        Policy::from_bytes(manifest, graph, file, 1)
    });
    match loaded {
        Ok(policy) => policy.manifest.num_obs() > 0,
        Err(error) => {
            assert!(error.to_string().starts_with("policy.onnx: ") && !error.remedy.is_empty(), "{error}");
            false
        }
    }
}

//! Nearest known names, for error messages.

/// Least similarity of two names (0 to 1) for which one is suggested for the other.
const SIMILARITY: f64 = 0.6;

/// At most three of `known`, the most similar to `name` first; empty when none is similar.
pub(super) fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Vec<&'a str> {
    let wanted = name.to_lowercase();
    let mut scored: Vec<(f64, &str)> = known
        .into_iter()
        .map(|candidate| (similarity(&wanted, &candidate.to_lowercase()), candidate))
        .filter(|(score, _)| *score >= SIMILARITY)
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(b.1)));
    scored.truncate(3);
    scored.into_iter().map(|(_, candidate)| candidate).collect()
}

/// The remedy for an unknown name: the nearest one, or the whole list when nothing is near.
pub(crate) fn did_you_mean<'a>(name: &str, known: impl IntoIterator<Item = &'a str>, plural: &str) -> String {
    let known: Vec<&str> = known.into_iter().collect();
    match nearest(name, known.iter().copied()).first() {
        Some(best) => format!("did you mean `{best}`?"),
        None if known.is_empty() => format!("remove it, there are no {plural} here"),
        None => format!("known {plural}: {}", known.join(", ")),
    }
}

/// Whether `key` looks like a typing error for `known`. Stricter than [`nearest`], as it turns an
/// otherwise legal key into an error: a single exchanged letter does not count, because `lin_vel_x`
/// and `lin_vel_y` both exist.
pub(super) fn is_slip(key: &str, known: &str) -> bool {
    let substituted = key.len() == known.len() && key.bytes().zip(known.bytes()).filter(|(a, b)| a != b).count() == 1;
    let allowed = if known.len() < 6 { 1 } else { 2 };
    key != known
        && !substituted
        && key.chars().next() == known.chars().next()
        && strsim::damerau_levenshtein(key, known) <= allowed
}

/// Edit similarity; a name that begins with, or is contained in, the other one counts as near, too.
fn similarity(wanted: &str, candidate: &str) -> f64 {
    let edits = strsim::normalized_damerau_levenshtein(wanted, candidate);
    let contained = wanted.len() >= 3 && candidate.contains(wanted);
    if contained { edits.max(SIMILARITY) } else { edits }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_similar_name_comes_first() {
        assert_eq!(nearest("wieght", ["height", "weight", "std"]), ["weight", "height"]);
        assert_eq!(nearest("zzz", ["weight"]), Vec::<&str>::new());
    }

    #[test]
    fn slips_are_told_from_other_keys() {
        assert!(is_slip("wieght", "weight"));
        assert!(is_slip("weigt", "weight"));
        assert!(!is_slip("height", "weight"));
        assert!(!is_slip("lin_vel_x", "lin_vel_y"));
        assert!(!is_slip("mode_time", "mode"));
    }
}

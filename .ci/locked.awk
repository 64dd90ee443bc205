# Prints a package of uv.lock as a requirement of pip, with the SHA-256 of each of its files:
#   awk -v package=uv -f .ci/locked.awk uv.lock
/^\[\[package\]\]/ { found = 0 }
$0 == "name = \"" package "\"" { found = 1 }
found && /^version = / { split($0, words, "\""); printf "%s==%s", package, words[2] }
found {
    while (match($0, /sha256:[0-9a-f]+/)) {
        printf " --hash=%s", substr($0, RSTART, RLENGTH)
        $0 = substr($0, RSTART + RLENGTH)
    }
}
END { print "" }

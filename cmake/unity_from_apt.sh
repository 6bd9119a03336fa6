#!/usr/bin/env bash
# unity_from_apt.sh FOLDER VERSION: downloads the upstream archive of the source package ntpsec VERSION to FOLDER and
# prints its path. The machine's apt configuration stays as it is: its own package sources are copied to FOLDER
# and asked for sources instead of packages. Needs no root. On failure one line on standard error, status 1.
set -euo pipefail

folder=$1
version=$2

fail() {
    echo "$*" >&2
    exit 1
}

command -v apt-get >/dev/null || fail "this machine has no apt-get"

mkdir -p "$folder/sources" "$folder/lists/partial" "$folder/cache/archives/partial"
folder=$(cd "$folder" && pwd)

# Both formats of source entries, one-line and deb822; only the distribution's own, whose suites carry its code name.
# shellcheck disable=SC1091
codename=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
[ -n "$codename" ] || fail "this distribution has no code name"
shopt -s nullglob
for file in /etc/apt/sources.list /etc/apt/sources.list.d/*.list; do
    [ -r "$file" ] || continue
    sed -n -E "/[[:space:]]$codename([[:space:]/-]|\$)/ s/^[[:space:]]*deb([[:space:]])/deb-src\\1/p" "$file"
done | sort -u >"$folder/sources/from-lists.list"
number=0
for file in /etc/apt/sources.list.d/*.sources; do
    [ -r "$file" ] || continue
    number=$((number + 1))
    # Paragraphs are split by hand: a line that holds white space only ends one, too.
    sed -E 's/^[[:space:]]+$//' "$file" |
        awk -v RS= -v ORS='\n\n' -v suite="(^|\n)Suites:[^\n]*[ \t]$codename" '$0 ~ suite {
            gsub(/(^|\n)Types:[^\n]*/, "\nTypes: deb-src"); sub(/^\n/, ""); print }' >"$folder/sources/$number.sources"
done

options=(
    -qq
    -o Dir::Etc::sourcelist=/dev/null
    -o Dir::Etc::sourceparts="$folder/sources"
    -o Dir::State::lists="$folder/lists"
    -o Dir::Cache="$folder/cache"
    -o APT::Sandbox::User="$(id -un)"
    -o Acquire::Retries=2
    -o Acquire::http::Timeout=20
    -o Acquire::https::Timeout=20
    -o Acquire::Languages=none
)
cd "$folder"
# One source that does not answer is no failure yet: the package decides.
timeout 180 apt-get "${options[@]}" update >update.log 2>&1 || true

archive=$(timeout 60 apt-get "${options[@]}" --print-uris --only-source --tar-only source ntpsec 2>source.log |
    awk '{ print $2 }' | grep -x "ntpsec_${version//+/[+]}[.]orig[.]tar[.][a-z0-9]*" | head -n 1) || true
if [ -z "$archive" ]; then
    trouble=$(grep -h -m 1 -E '^(E|W):' update.log || true)
    fail "the package sources of $codename offer no ntpsec $version${trouble:+ ($trouble)}"
fi
timeout 180 apt-get "${options[@]}" --download-only --only-source --tar-only source ntpsec >>source.log 2>&1 ||
    fail "apt-get source ntpsec failed: $(tail -n 1 source.log)"
[ -f "$archive" ] || fail "apt-get source ntpsec left no $archive"
echo "$folder/$archive"

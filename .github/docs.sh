#!/usr/bin/env bash
# Commits the site of a version to the branch gh-pages: docs.sh main, or docs.sh vX.Y.Z; --push pushes it.
set -euo pipefail
name=$1
shift
if [[ $name == v* ]]; then
  version=${name#v}
  mike deploy --update-aliases "${version%.*}" latest "$@"
  mike set-default latest "$@"
else
  mike deploy dev "$@"
fi

#!/usr/bin/env bash
# Installs a wheel into an empty environment and uses it: smoke.sh dist/softgym_envs-X.Y.Z-py3-none-any.whl
# TORCH_INDEX= takes the torch of pip's own index.
set -euo pipefail
wheel=$(realpath "$1")
index=${TORCH_INDEX-https://download.pytorch.org/whl/cpu}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv venv
start=$SECONDS
venv/bin/python -m pip install --quiet "$wheel"
echo "core: $((SECONDS - start)) s, $(du -sm venv | cut -f1) MB"
venv/bin/softgym doctor
venv/bin/softgym rollout SoftGym/FingerReach-v0 --agent qp
venv/bin/softgym rollout SoftGym/FingerReach-v0 --agent qp --backend fem
start=$SECONDS
if [ -n "$index" ]; then venv/bin/python -m pip install --quiet torch --index-url "$index"; fi
venv/bin/python -m pip install --quiet "$wheel[codesign]"
echo "with codesign: $((SECONDS - start)) s more, $(du -sm venv | cut -f1) MB"
venv/bin/softgym codesign --config finger_reach --folder study --quiet trials=4
test -s study/report.html
echo "smoke test passed"

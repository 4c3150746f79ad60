#!/bin/sh
# Minari 0.5.4: `combine_datasets` brings back the episodes that `filter_episodes` has left out.
#
# Guess before the run: a data set of which a filter keeps 2 of 6 episodes, combined with one of 3, has 5 episodes.
# Seen: it has 9. `len(filtered)` is 2 and iterating gives those 2; only the combination copies the whole storage.
# Source: MinariDataset.filter_episodes in minari/dataset/minari_dataset.py returns indices beside the same storage;
# combine_datasets in minari/utils.py passes `dataset.storage` to update_from_storage, which knows no indices.
# For whom: whoever filters failures out of demonstrations before joining sets for training, or judges the joined set.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export MINARI_DATASETS_PATH="$folder/sets"
mkdir "$MINARI_DATASETS_PATH"

cat >"$folder/run.py" <<'PY'
from importlib.metadata import version

import gymnasium
import minari


def collected(name, episodes):
    collector = minari.DataCollector(gymnasium.make("CartPole-v1"), record_infos=False)
    for seed in range(episodes):
        collector.reset(seed=seed)
        for step in range(5 + seed):
            collector.step(step % 2)
    return collector.create_dataset(
        dataset_id=name,
        algorithm_name="scripted",
        code_permalink="https://example.org",
        author="none",
        author_email="none@example.org",
    )


first = collected("cart/first-v0", 6)
second = collected("cart/second-v0", 3)
kept = first.filter_episodes(lambda episode: len(episode.actions) >= 9)
both = minari.combine_datasets([kept, second], "cart/both-v0")
print("minari", version("minari"))
print("kept by the filter:", len(kept), "lengths", sorted(len(episode.actions) for episode in kept.iterate_episodes()))
print("combined with 3:", len(both), "lengths", sorted(len(episode.actions) for episode in both.iterate_episodes()))
PY

python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "minari[create,hdf5]==0.5.4" "gymnasium==1.2.3" "pillow==12.0.0"
"$folder/venv/bin/python" -W ignore "$folder/run.py" >"$folder/output" 2>"$folder/errors" || {
    cat "$folder/errors"
    exit 1
}
diff "$folder/output" - <<'EXPECTED'
minari 0.5.4
kept by the filter: 2 lengths [9, 10]
combined with 3: 9 lengths [5, 5, 6, 6, 7, 7, 8, 9, 10]
EXPECTED
echo "minari 0.5.4: as described"

"""Which photographs may show the same things, by their looks: what is compared instead of all pairs.

A photograph is described by its own SIFT features in a vocabulary of the capture itself: VLAD (Jegou et al. 2010) with
normalized residuals (Arandjelovic and Zisserman 2013). All is drawn from a seed, and ties go to the lower number.
"""

from collections import Counter, defaultdict
from collections.abc import Callable
from itertools import combinations, pairwise

import numpy as np

Pairs = list[tuple[int, int]]  # places of photographs in their order, the lower one first

# Words of the vocabulary. Tried, on a walk of 150 photographs through rooms: the share of the pairs that fit which are
# among the 30 that look most alike.
# - 77 % instead of 88 %: 64 words
# - 76 % and 87 %: square roots of the residuals, of 64 and of 256 words
# - 80 %: 2,048 features as words, counted (tf-idf)
WORDS = 256
SAMPLE, ROUNDS = 40_000, 10  # features that it is made of, and rounds of k-means
NEAREST = 30  # photographs that look most alike, which each is compared with
NEIGHBORS = 10  # and so many before and after it in their order
THROUGH = 150  # features that two photographs share with others, from which on they are compared, too
ORDERED = 0.5  # share of photographs next to one of their NEAREST, from which on their order means something


def described_by_words(features: Callable[[int], np.ndarray], count: int, seed: int) -> np.ndarray:
    """Descriptions [count, WORDS * 128] float32 of unit length, zeros without features.

    Args:
        features: those of a photograph by its place, [F, 128] of any numbers.
        count: of the photographs.
        seed: of the vocabulary.
    """
    random = np.random.default_rng(seed)
    share, every = -(-SAMPLE // count), map(features, range(count))
    known = np.concatenate([found[random.permutation(len(found))[:share]].astype(np.float32) for found in every])
    words = vocabulary(known if len(known) else np.zeros((1, known.shape[1]), np.float32), random)
    described = np.zeros((count, *words.shape), np.float32)
    for index in range(count):
        found = features(index).astype(np.float32)
        belongs = _nearest(found, words)
        described[index] = belongs.T @ found - belongs.sum(0)[:, None] * words
    described /= np.maximum(np.linalg.norm(described, axis=2, keepdims=True), 1e-6)
    described = described.reshape(count, -1)
    return described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-6)


def vocabulary(sample: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """WORDS centers of the features ``sample`` [S, D] by k-means; one that nothing belongs to stays where it was."""
    words = sample[random.permutation(len(sample))[:WORDS]]
    for _ in range(ROUNDS):
        belongs = _nearest(sample, words)
        counts = belongs.sum(0)[:, None]
        words = np.where(counts > 0, belongs.T @ sample / np.maximum(counts, 1), words)
    return words


def _nearest(found: np.ndarray, words: np.ndarray) -> np.ndarray:
    """1 at the word that is nearest to each feature, else 0, [F, W] float32."""
    return np.eye(len(words), dtype=np.float32)[(found @ words.T - 0.5 * (words * words).sum(1)).argmax(1)]


def alike(described: np.ndarray, most: int = NEAREST) -> Pairs:
    """Each photograph with those that look most like it."""
    pairs = set()
    for index, one in enumerate(described):
        likeness = np.round((described @ one).astype(np.float64), 4)  # sums of other threads end in other digits
        likeness[index] = -np.inf
        for other in np.argsort(-likeness, kind="stable")[: min(most, len(described) - 1)].tolist():
            pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def next_in_order(count: int, looks: Pairs) -> Pairs:
    """Neighbors among the photographs; none if neighbors do not look alike, and so their order means nothing."""
    if len({*looks}.intersection(pairwise(range(count)))) < ORDERED * (count - 1):
        return []
    return [(one, other) for one in range(count) for other in range(one + 1, min(one + 1 + NEIGHBORS, count))]


def beyond(matched: dict[tuple[int, int], int], tried: set[tuple[int, int]]) -> Pairs:
    """Pairs that were not ``tried``, whose photographs fit to common third ones by at least THROUGH features in all.

    At most NEAREST for each photograph, those that fit best; ``matched``: by how many features pairs fit.
    """
    fits: dict[int, dict[int, int]] = defaultdict(dict)
    for (a, b), count in matched.items():
        fits[a][b] = fits[b][a] = count
    score: dict[tuple[int, int], int] = defaultdict(int)
    for middle in sorted(fits):
        for (a, to_a), (b, to_b) in combinations(sorted(fits[middle].items()), 2):
            if (a, b) not in tried:
                score[a, b] += min(to_a, to_b)
    taken, partners = [], Counter()
    for pair in sorted(score, key=lambda pair: (-score[pair], pair)):
        if score[pair] >= THROUGH and all(partners[each] < NEAREST for each in pair):
            taken.append(pair)
            partners.update(pair)
    return sorted(taken)

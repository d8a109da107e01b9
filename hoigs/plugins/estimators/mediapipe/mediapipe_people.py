"""Read by `mediapipe_script.py`: the people whom the user clicked on, each followed as themselves.

Squares that follow people from frame to frame meet where people cross, and one may then go on with
the other's person. Colours of clothes, and ways of walking, tell them apart. It imports nothing of
hoigs.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from mediapipe_check import hips_square
from mediapipe_chosen import ON, ChosenPose, same

LEVELS = 6  # of each of red, green and blue, by which clothes are compared
HIPS = [23, 24]  # landmarks
APART = 0.6  # in sides, of the squares' middles: what is seen of each is theirs alone
UNLIKE = 0.08  # difference of similarities (0 to 1) from which clothes tell people apart
RENEWED = 0.03  # share of the newest frame in how a person looks
DRAWN = 0.9  # of the last step, the next one of a person who is lost
AGAIN = 5  # frames between searches for the lost
LEAST, STEP = 0.5, 0.35  # of a search for the lost: similarity, and step in sides


class Person:
    """One person: the square, how it moves and how they look."""

    def __init__(self, graph, rect, prompts) -> None:
        self.pose = ChosenPose(graph, rect, prompts)
        self.begin = min(prompts)
        self.looks: np.ndarray | None = None
        self.step = np.zeros(2)  # pixels a frame
        self.lost = 0  # frames

    def expected(self):
        return np.array(self.pose.square[:2]) + self.step

    def take(self, square):
        """Whose place is known; a later step begins here."""
        if self.pose.first is not None and not self.lost:
            self.step = 0.7 * self.step + 0.3 * (np.array(square[:2]) - self.pose.square[:2])
        self.lost = 0
        self.pose.take(square)

    def lose(self, shape):
        """Not seen: goes on as before, ever slower, and not out of the picture."""
        self.lost += 1
        self.step = DRAWN * self.step
        x, y = self.expected().clip(0, [shape[1], shape[0]])
        self.pose.square = (float(x), float(y), self.pose.square[2])

    def restart(self):
        self.step, self.lost = np.zeros(2), 0
        self.pose.restart()


class People:
    """Everybody who was clicked on.

    Args:
        graph, rect: of `landmark_graph`.
        prompts: by name, then as `ChosenPose` has them.
        order: numbers of the frames as they come: first `shown` that show how people look, then
            from the first prompt's forwards, then from the last person's first prompt backwards.
        back: place of the first of the latter.
    """

    def __init__(self, graph, rect, prompts, order, back, shown=0) -> None:
        self.people = {name: Person(graph, rect, p) for name, p in prompts.items()}
        self.order, self.back, self.shown = order, back, shown

    def process(self, place, image):
        """By name, landmarks in the image and in space and the mask of those who are followed in
        this pass; None of those who are lost.

        Raises:
            LookupError: nobody, or somebody else, is where a prompt says; its one argument ends
                with the person's name and the frame.
        """
        number = self.order[place]
        if place < self.shown:
            self.meet(number, image)
            return {}
        if place == self.back:
            for person in self.people.values():
                person.restart()
        forwards = place < self.back
        here = {n: p for n, p in self.people.items() if (p.begin <= number) == forwards}
        seen = {name: self.seen(name, number, image) for name in here}
        seen = {name: found for name, found in seen.items() if found is not None}
        looks = {name: looks_of(image, found) for name, (_, found) in seen.items()}
        for name in seen:
            if self.people[name].looks is None:
                self.people[name].looks = looks[name]
        for name in self.mistaken(number, seen, looks):
            del seen[name]
        for name, person in here.items():
            if name in seen:
                person.take(seen[name][0])
            else:
                person.lose(image.shape)
                found = self.recovered(name, image, seen)
                if found is not None:
                    seen[name] = found
                    person.take(found[0])
        self.remember(seen, looks)
        return {name: seen[name][1] if name in seen else None for name in here}

    def meet(self, number, image):
        """How those look who are clicked on in this frame first."""
        for name, person in self.people.items():
            if person.begin == number and person.looks is None:
                _, found = self.seen(name, number, image)
                person.looks = looks_of(image, found)

    def seen(self, name, number, image):
        """Square and what is seen of a person, by the prompt or in their square."""
        person = self.people[name]
        prompted = number in person.pose.prompts
        followed = person.pose.followed(image) if person.pose.first is not None else None
        if not prompted:
            return followed
        try:
            found = person.pose.prompted(number, image)
        except LookupError as error:
            raise LookupError(f"{error} of {name}") from error
        if followed is not None and not one_person(followed, found):
            own, other = (person.looks @ looks_of(image, f[1]) for f in (followed, found))
            if own > other + UNLIKE:
                raise LookupError(f"someone else is there: {number} of {name}")
        return found

    def mistaken(self, number, seen, looks):
        """Names of those who are not the person seen in their square."""
        wrong = set()
        likeness = {
            (a, b): float(looks[a] @ self.people[b].looks)
            for a in seen for b in self.people if self.people[b].looks is not None
        }  # fmt: skip
        for (a, b), value in likeness.items():
            prompted = number in self.people[a].pose.prompts
            if a != b and not prompted and value > likeness[a, a] + UNLIKE:
                wrong.add(a)
        for a, b in combinations(seen, 2):
            if wrong & {a, b} or not one_person(seen[a], seen[b]):
                continue
            more = likeness[a, a] - likeness[a, b]
            if abs(more) < UNLIKE:  # alike: whose way leads here?
                middle = np.array(seen[a][0][:2])
                ways = (self.people[n].expected() - middle for n in (a, b))
                away = [float(np.linalg.norm(way)) for way in ways]
                more = away[1] - away[0]
            wrong.add(b if more > 0 else a)
        return wrong

    def recovered(self, name, image, seen):
        """Square and what is seen of a person who was lost among others, anywhere at their
        height; None unless clothes say that it is them."""
        person = self.people[name]
        if len(self.people) < 2 or person.lost % AGAIN or person.looks is None:
            return None
        _, y, side = person.pose.square
        best = None
        for x in np.arange(STEP * side / 2, image.shape[1], STEP * side):
            found = person.pose.look(image, (float(x), y, side))
            if found is None:
                continue
            place = hips_square(found[0])
            if any(one_person((place, found), other) for other in seen.values()):
                continue
            looks = looks_of(image, found)
            others = [looks @ p.looks for n, p in self.people.items()
                      if n != name and p.looks is not None]  # fmt: skip
            value = float(looks @ person.looks)
            if value < max(LEAST, max(others, default=0.0) + UNLIKE):
                continue
            if best is None or value > best[0]:
                best = value, (place, found)
        return None if best is None else best[1]

    def remember(self, seen, looks):
        """How people look now, where nobody else is near."""
        for name, (square, _) in seen.items():
            alone = all(
                np.hypot(square[0] - other[0], square[1] - other[1]) > APART * square[2]
                for n, (other, _) in seen.items()
                if n != name
            )
            person = self.people[name]
            if alone and name in looks and person.looks is not None:
                mean = (1 - RENEWED) * person.looks**2 + RENEWED * looks[name] ** 2
                person.looks = np.sqrt(mean)


def one_person(one, other) -> bool:
    """Whether what two squares show is the same person."""
    (square, found), (_, others) = one, other
    return same(found[0], others[0], square[2])


def looks_of(image, found):
    """Square roots of the shares of colours above and below the hips; the product of two of them
    is 1 if they are equal (Bhattacharyya)."""
    points, _, mask = found
    bins = (image.astype(int) * LEVELS // 256) @ [1, LEVELS, LEVELS**2]
    inside = mask > ON
    above = np.arange(len(image))[:, None] < points[HIPS, 1].mean()
    shares = [
        np.bincount(bins[inside & part], minlength=LEVELS**3).astype(float)
        for part in (above, ~above)
    ]
    return np.sqrt(np.concatenate([s / max(s.sum(), 1.0) for s in shares]) / 2)

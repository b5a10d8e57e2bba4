// On which sides of their constraints contacts and limits are taken to be.

// On which sides the next direction takes own contacts to be, below their ids, and own limits.
unsigned contact_sides[CONTACT_SLOTS];
enum LimitSide : unsigned char { NO_LIMIT, OPEN, CLOSED } limit_sides[Model::LIMIT_SIDES][SLOTS] = {};
int frictional_before = 0, frictionless_before = 0;  // contacts of the substep before

INLINE bool has_friction(int own) const { return own < OWN_FRICTIONAL; }
INLINE int number(int own, int lane) const { return lane + LANES * (has_friction(own) ? own : own - OWN_FRICTIONAL); }
INLINE int number(int own) const { return number(own, lane); }
INLINE bool exists(int own) const { return number(own) < (has_friction(own) ? frictional : frictionless); }
// The sides of an own contact, 0 if it is open, or none: as they are taken, and as they are.
INLINE unsigned sides(int own) const { return contact_sides[own] & ((1u << SIDE_BITS) - 1); }
INLINE unsigned sides_now(int own) const {
  if (!exists(own)) return 0;
  return has_friction(own) ? sides_of(number(own))
                           : (unsigned)(is_equality(number(own)) || w.x[first_frictionless() + number(own)] < 0.0f);
}
INLINE LimitSide limit_side_now(int row) const { return row < 0 ? NO_LIMIT : w.x[row] < 0.0f ? CLOSED : OPEN; }

// Takes contacts and limits to be where they were at the end of the substep before, which is right more often than what
// its acceleration says now; what is new, where it is. Returns whether some are elsewhere now.
INLINE bool guess_sides() {
  bool differs = false;
  unsigned found[CONTACT_SLOTS];
  OWN_PLACES(own, 0, CONTACT_SLOTS) {
    const bool friction = has_friction(own);
    const unsigned now = sides_now(own);
    const unsigned id = exists(own) ? w.contacts[number(own) + (friction ? 0 : Model::FRICTIONAL)].id : NO_CONTACT;
    found[own] = id << SIDE_BITS | now;
    int left = !GUESSES ? 0 : friction ? frictional_before : frictionless_before;
    OWN_PLACES(slot, friction ? 0 : OWN_FRICTIONAL, friction ? OWN_FRICTIONAL : CONTACT_SLOTS) {
      const int some = left < LANES ? left : LANES;
      ROLLED_FOR(int from = 0; from < some; ++from) {
        const unsigned before = read(contact_sides[slot], from);
        if (before >> SIDE_BITS == id) found[own] = before;
      }
      left -= some;
    }
    differs = differs || (found[own] ^ now) << (32 - SIDE_BITS);
  }
  OWN_PLACES(own, 0, CONTACT_SLOTS) contact_sides[own] = found[own];
  OWN_DOFS(slot, d)
    UNROLLED_FOR(int side = 0; side < Model::LIMIT_SIDES; ++side) {
      const LimitSide now = limit_side_now(limit_row[side][slot]), before = limit_sides[side][slot];
      limit_sides[side][slot] = GUESSES && now != NO_LIMIT && before != NO_LIMIT ? before : now;
      differs = differs || limit_sides[side][slot] != now;
    }
  frictional_before = frictional;
  frictionless_before = frictionless;
  return ballot(differs) != 0;
}

// Takes contacts and limits to be where they are, and returns whether some were elsewhere, or nowhere on a parabola.
INLINE bool find_sides() {
  bool differs = false;
  OWN_PLACES(own, 0, CONTACT_SLOTS) {
    const unsigned now = sides_now(own);
    differs = differs || now != sides(own);
    differs = differs || (Model::ELLIPTIC && has_friction(own) && now == Cone::SLIDING);
    contact_sides[own] = contact_sides[own] >> SIDE_BITS << SIDE_BITS | now;
  }
  OWN_DOFS(slot, d)
    UNROLLED_FOR(int side = 0; side < Model::LIMIT_SIDES; ++side) {
      const LimitSide now = limit_side_now(limit_row[side][slot]);
      differs = differs || now != limit_sides[side][slot];
      limit_sides[side][slot] = now;
    }
  return differs;
}

/* Burst alignment, position by position: `offsets.align_in_numpy` in one pass over the card's words. The words of a
   position (64 KB) come from the cache, where they were read to (`chain.py`). The method is described in `offsets.py` and
   `loops.py`. */
#include "passes.h"

#define REFERENCES 4       /* `offsets._REFERENCES` */
#define GOOD 0.5           /* `offsets._GOOD` */
#define SMALLEST_GAIN 0.25 /* `high_pass_filter.SMALLEST_GAIN` */

/* `high_pass_filter.Equaliser`; without corners there is one tap, 1. */
typedef struct {
    int taps, is_signed, corners;
    double sample_rate_hz, reach, even, odd; /* even, odd: factors of `find_taps` */
    const double *corners_hz;
} Equaliser;

/* conj(H) / max(|H|^2, SMALLEST_GAIN^2), `HighPass.inverse`. */
static Complex inverse(const Equaliser *e, double frequency)
{
    double turns = e->is_signed ? frequency - floor(frequency + 0.5) : frequency - floor(frequency);
    double f = turns * e->sample_rate_hz, limit = SMALLEST_GAIN * SMALLEST_GAIN;
    Complex h = {1, 0};
    if (fabs(f) < 1)
        f = 1;
    for (int i = 0; i < e->corners; i++)
        h = times(h, (Complex){1, -e->corners_hz[i] / f});
    double gain = h.re * h.re + h.im * h.im, part = gain * limit > 1 ? 1 / (gain * limit) : 1;
    return (Complex){h.re * part, h.im * part};
}

/* `Equaliser.taps`. */
static void find_taps(const Equaliser *e, double frequency, Complex *taps)
{
    if (e->taps == 1) {
        taps[0] = (Complex){1, 0};
        return;
    }
    Complex low = inverse(e, frequency - e->reach), middle = inverse(e, frequency), high = inverse(e, frequency + e->reach);
    Complex both = {((low.re + high.re) / 2 - middle.re) * e->even, ((low.im + high.im) / 2 - middle.im) * e->even};
    Complex apart = {(high.im - low.im) * e->odd, -(high.re - low.re) * e->odd}; /* divided by j */
    taps[0] = (Complex){(both.re - apart.re) / 2, (both.im - apart.im) / 2};
    taps[1] = (Complex){middle.re - both.re, middle.im - both.im};
    taps[2] = (Complex){(both.re + apart.re) / 2, (both.im + apart.im) / 2};
}

/* Work arrays of one position, per chirp. */
typedef struct {
    int *order;
    double *frequency, *found, *coherence, *sorted;
    Complex *product, *found_product, *taps;
    float *energy;
    uint8_t *usable, *second_half;
} Chirps;

/* Results, [position][chirp] unless noted. */
typedef struct {
    float *mean, *halves; /* complex [position][RX][sample] and [position][2][RX][block] */
    double *centre;       /* [position] */
    uint8_t *good;
    double *frequency, *phase, *amplitude, *gain, *frequency_error, *phase_error, *coherence;
    int32_t *peak;
} Aligned;

/* `offsets._coherent`: usable chirps with at least GOOD of the median coherence of their position. */
static void choose_coherent(const double *coherence, const uint8_t *usable, int chirps, double *sorted, uint8_t *good)
{
    int count = 0;
    for (int k = 0; k < chirps; k++)
        if (usable[k]) {
            int i = count++;
            for (; i > 0 && sorted[i - 1] > coherence[k]; i--)
                sorted[i] = sorted[i - 1];
            sorted[i] = coherence[k];
        }
    for (int k = 0; k < chirps; k++)
        good[k] = usable[k] && coherence[k] >= GOOD * sorted[(count - 1) / 2];
}

/* Chirps of a kind first, then the others, each in order of recording; the first `fixed` stay. */
static void put_first(int *order, const uint8_t *kind, int chirps, int fixed)
{
    int at = fixed;
    for (int wanted = 1; wanted >= 0; wanted--)
        for (int k = 0; k < chirps; k++)
            if ((kind[k] != 0) == wanted && !(fixed && k == order[0]))
                order[at++] = k;
}

/* `offsets._against_one`: offsets relative to one chirp; try another if it is not usable or matches few of the others.
   Returns the middle of the signal's band. */
static double against_one(Work *w, Chirps *c, const uint8_t *valid, int full_scale, const int32_t *peak)
{
    int chirps = w->chirps, reference = 0, usable = 0;
    double best_sum = -1, best = 0, centre = 0, noise = 4 / sqrt((double)RX * w->n);
    put_first(c->order, valid, chirps, 0);
    for (int attempt = 0; attempt < REFERENCES && attempt < chirps; attempt++) {
        int tried = c->order[attempt], matching = 0;
        double sum = 0, middle = match(w, tried, c->found, c->found_product, c->energy);
        for (int k = 0; attempt == 0 && k < chirps; k++)
            usable += c->usable[k] = valid[k] && peak[k] < full_scale && c->energy[k] > 0;
        if (attempt == 0)
            put_first(c->order, c->usable, chirps, 1);
        for (int k = 0; k < chirps; k++) {
            double energy = (double)c->energy[k] * c->energy[tried];
            double match = magnitude(c->found_product[k]) / sqrt(energy > 1e-30 ? energy : 1e-30);
            c->sorted[k] = c->usable[k] && k != tried ? match : 0; /* a chirp always matches itself */
            sum += c->sorted[k];
            matching += c->sorted[k] > noise;
        }
        sum = c->usable[tried] ? sum : -1;
        if (sum >= best_sum) {
            best_sum = sum;
            reference = tried;
            centre = middle;
            memcpy(c->coherence, c->sorted, sizeof *c->coherence * chirps);
            memcpy(c->frequency, c->found, sizeof *c->frequency * chirps);
            memcpy(c->product, c->found_product, sizeof *c->product * chirps);
        }
        if (!usable || (c->usable[tried] && 2 * matching >= usable - 1))
            break;
    }
    for (int k = 0; k < chirps; k++)
        best = c->coherence[k] > best ? c->coherence[k] : best;
    c->coherence[reference] = c->usable[reference] ? best : 0; /* the reference is as good as its best match */
    return centre;
}

/* Subtract the mean over the good chirps and halve the values; zero where not good. */
static void centre_errors(double *values, const uint8_t *good, int chirps, int count)
{
    double mean = 0;
    for (int k = 0; k < chirps; k++)
        mean += good[k] ? values[k] / count : 0;
    for (int k = 0; k < chirps; k++)
        values[k] = good[k] ? (values[k] - mean) / 2 : 0;
}

static void align_position(Work *w, Chirps *c, const Equaliser *e, const int16_t *words, const uint8_t *valid,
                           int full_scale, Aligned out)
{
    int chirps = w->chirps, count = 0, half = 0;
    for (int k = 0; k < chirps; k++) /* reads all words in order, into the first caches */
        out.peak[k] = largest(words + 2 * RX * k * w->samples, 2 * RX * w->samples);
    part_iq(words, chirps * w->samples, w->i, w->q);
    *out.centre = against_one(w, c, valid, full_scale, out.peak);
    choose_coherent(c->coherence, c->usable, chirps, c->sorted, out.good);
    for (int k = 0; k < chirps; k++) {
        Complex *taps = c->taps + k * e->taps, sum = {0, 0};
        out.frequency[k] = *out.centre + c->frequency[k];
        find_taps(e, out.frequency[k], taps);
        for (int t = 0; t < e->taps; t++)
            sum.re += taps[t].re, sum.im += taps[t].im;
        out.gain[k] = magnitude(sum);
        out.phase[k] = angle(times(c->product[k], sum));
        for (int t = 0; t < e->taps; t++)
            taps[t] = times(taps[t], cis(-out.phase[k] / TURN));
        count += out.good[k];
    }

    /* Each chirp against the sum of the others; its difference from the mean of all chirps is smaller. */
    double level = against_others(w, out.frequency, c->taps, e->taps, out.good, c->found, c->found_product,
                                  c->energy, out.frequency_error, out.phase_error);
    level /= count > 1 ? (double)count * count : 1;
    level = level > 1e-30 ? level : 1e-30;
    for (int k = 0; k < chirps; k++) {
        int others = count - out.good[k];
        double part = (double)others / (count > 1 ? count : 1), own = c->energy[k] > 1e-30 ? c->energy[k] : 1e-30;
        double shift = part * angle(c->found_product[k]), correction = part * c->found[k];
        out.amplitude[k] = others > 0 ? magnitude(c->found_product[k]) / others / level : 1;
        out.coherence[k] = out.amplitude[k] * sqrt(level / own);
        out.phase[k] = remainder(out.phase[k] + shift, TURN);
        out.frequency[k] += correction;
        c->frequency[k] += correction;
        /* Filtering and then turning equals turning and then filtering with turned taps. */
        for (int t = 0; t < e->taps; t++) {
            Complex turn = cis(FOLD * (t - e->taps / 2) * correction - shift / TURN);
            c->taps[k * e->taps + t] = times(c->taps[k * e->taps + t], turn);
        }
    }
    choose_coherent(out.coherence, c->usable, chirps, c->sorted, out.good);
    count = 0;
    for (int k = 0; k < chirps; k++)
        count += out.good[k];
    for (int k = 0; k < chirps; k++) {
        half += out.good[k];
        c->second_half[k] = half % 2 == 0;
        for (int t = 0; t < e->taps; t++) {
            c->taps[k * e->taps + t].re /= count > 1 ? count : 1;
            c->taps[k * e->taps + t].im /= count > 1 ? count : 1;
        }
    }
    average(w, out.frequency, c->taps, e->taps, out.good, c->second_half, out.mean, out.halves);
    memcpy(out.frequency, c->frequency, sizeof *c->frequency * chirps);
    centre_errors(out.frequency_error, out.good, chirps, count);
    centre_errors(out.phase_error, out.good, chirps, count);
}

/* Reserve space for values of a size in `memory` on its own cache lines; only count it if memory is NULL. */
static void *room(float *memory, size_t *used, size_t count, size_t size)
{
    void *here = memory ? memory + *used : NULL;
    *used += (count * size / sizeof(float) + LANES) / LANES * LANES;
    return here;
}

/* Assign all arrays to memory; return the number of floats needed. */
static size_t lay_out(Work *w, Chirps *c, int taps, float *memory)
{
    size_t used = 0, row = (size_t)LANES * (w->samples + 2 * FOLD), chirps = w->chirps, size = w->size;
    size_t values = (size_t)RX * w->blocks, padded = (size_t)RX * (w->samples + 2 * FOLD);
    float **rows[] = {&w->row_re, &w->row_im, &w->spare}, **columns[] = {&w->re, &w->im};
    float **chirp[] = {&w->one_re, &w->one_im, &w->phase_c, &w->phase_s};
    for (int i = 0; i < 3; i++)
        *rows[i] = room(memory, &used, row, sizeof(float));
    for (int i = 0; i < 2; i++)
        *columns[i] = room(memory, &used, LANES * size, sizeof(float));
    for (int i = 0; i < 4; i++)
        *chirp[i] = room(memory, &used, padded, sizeof(float));
    w->i = room(memory, &used, chirps * RX * w->samples + LANES, sizeof(float));
    w->q = room(memory, &used, chirps * RX * w->samples + LANES, sizeof(float));
    w->folded_re = room(memory, &used, whole_lanes(w->chirps) * values, sizeof(float));
    w->folded_im = room(memory, &used, whole_lanes(w->chirps) * values, sizeof(float));
    w->all_re = room(memory, &used, values, sizeof(float));
    w->all_im = room(memory, &used, values, sizeof(float));
    w->total = room(memory, &used, 4 * (size_t)RX * w->samples, sizeof(float));
    w->root_c = room(memory, &used, size, sizeof(float));
    w->root_s = room(memory, &used, size, sizeof(float));
    w->turn_c = room(memory, &used, RX * size, sizeof(float));
    w->turn_s = room(memory, &used, RX * size, sizeof(float));
    w->power = room(memory, &used, 3 * size, sizeof(double));
    w->smooth = room(memory, &used, 3 * size, sizeof(double));
    w->sums = room(memory, &used, 6 * PARTS * chirps, sizeof(double));
    w->tones = room(memory, &used, 5 * chirps, sizeof(double));
    w->bin = room(memory, &used, size, sizeof *w->bin);
    w->place = room(memory, &used, size, sizeof *w->place);
    c->order = room(memory, &used, chirps, sizeof *c->order);
    c->frequency = room(memory, &used, chirps, sizeof(double));
    c->found = room(memory, &used, chirps, sizeof(double));
    c->coherence = room(memory, &used, chirps, sizeof(double));
    c->sorted = room(memory, &used, chirps, sizeof(double));
    c->product = room(memory, &used, chirps, sizeof(Complex));
    c->found_product = room(memory, &used, chirps, sizeof(Complex));
    c->taps = room(memory, &used, chirps * taps, sizeof(Complex));
    c->energy = room(memory, &used, chirps, sizeof(float));
    c->usable = room(memory, &used, chirps, 1);
    c->second_half = room(memory, &used, chirps, 1);
    return used;
}

/* Compute tables that are the same for all positions. */
static void prepare(Work *w)
{
    roots_of_unity(w->size, w->root_c, w->root_s);
    for (int i = 0; i < w->size; i++) {
        w->bin[i] = bin_at(i, w->size);
        w->place[w->bin[i]] = i;
    }
    for (int i = 0; i < RX * w->size; i++) {
        int root = i % LANES / RX * (w->bin[i / LANES] / FOLD);
        w->turn_c[i] = w->root_c[root];
        w->turn_s[i] = w->root_s[root];
    }
    for (int p = 0; p <= w->parts; p++)
        w->edges[p] = p * w->blocks / w->parts;
    for (int p = 0; p < w->parts; p++)
        w->part_times[p] = FOLD * (w->edges[p] + w->edges[p + 1] - w->blocks) / 2.0;
}

/* `offsets.align_row` for four RX. words: int16 [position][chirp][sample][2][RX]; valid [position][chirp]; [a, b): linear
   samples, a whole number of blocks; size: of the transform; filter: sample rate, reach, IF signed, corners; equalise:
   compensate the filter. Returns 0, or 1 if there is not enough memory. */
int NAME(align)(const int16_t *words, const uint8_t *valid, int positions, int chirps, int samples, int a, int b,
                int size, int full_scale, const double *filter, int corners, int equalise, float *mean, float *halves, double *centre,
                uint8_t *good, double *frequency, double *phase, double *amplitude, double *gain, double *error,
                double *coherence, int32_t *peak)
{
    const double reach = TURN * filter[1] * FOLD; /* angle of a tap at this distance */
    const Equaliser e = {equalise ? 3 : 1, filter[2] != 0, corners, filter[0], filter[1], 1 / (cos(reach) - 1), 1 / (2 * sin(reach)),
                         filter + 3};
    const int blocks = (b - a) / FOLD;
    Work w = {.chirps = chirps, .samples = samples, .a = a, .b = b, .n = b - a, .blocks = blocks, .size = size};
    Chirps c;
    float *memory = reserve(lay_out(&w, &c, e.taps, NULL));
    if (!memory)
        return 1;
    lay_out(&w, &c, e.taps, memory);
    w.parts = blocks < PARTS ? blocks : PARTS;
    prepare(&w);
    for (int p = 0; p < positions; p++) {
        size_t at = (size_t)p * chirps;
        Aligned out = {.mean = mean + 2 * (size_t)p * RX * samples,
                       .halves = halves + 4 * (size_t)p * RX * blocks,
                       .centre = centre + p,
                       .good = good + at,
                       .frequency = frequency + at,
                       .phase = phase + at,
                       .amplitude = amplitude + at,
                       .gain = gain + at,
                       .frequency_error = error + 2 * at,
                       .phase_error = error + 2 * at + chirps,
                       .peak = peak + at};
        out.coherence = coherence + at;
        align_position(&w, &c, &e, words + at * samples * 2 * RX, valid + at, full_scale, out);
    }
    release(memory);
    return 0;
}

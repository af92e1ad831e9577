// Figures that move, drawn with BokehJS from the data that `graphslam.results.live_figure` embeds.
// Without scripts nothing of this is shown; the pictures of the page stay as they are.
"use strict";
(() => {
  const TYPES = { f8: Float64Array, f4: Float32Array, i2: Int16Array, i4: Int32Array };
  const FRAME_MS = 40; // between two steps of the replay
  const REPLAY_S = 20; // of the whole replay
  const MIN_DOT_M = 0.015; // dots of scans grow when zoomed in, up to MAX_DOT pixels
  const MAX_DOT = 4;
  const MOST_FITS = 4; // of a map, while its numbers find their room

  function decoded(array) {
    const bytes = Uint8Array.from(atob(array.data), (c) => c.charCodeAt(0));
    return new TYPES[array.type](bytes.buffer);
  }

  function cssColor(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }

  function rgb(name) {
    const text = cssColor(name).replace("#", "");
    return [0, 2, 4].map((i) => parseInt(text.slice(i, i + 2), 16));
  }

  // Splits columns of vertices into one array per line: `starts` are the first vertices.
  function split(values, starts) {
    return Array.from(starts, (begin, i) => values.subarray(begin, starts[i + 1]));
  }

  class Live {
    constructor(box) {
      this.box = box;
      this.data = JSON.parse(box.querySelector("script[type='application/json']").textContent);
      this.hidden = new Set();
      this.time = Infinity;
      this.swipe = 0;
      this.series = [];
      this.ready = this.build();
    }

    // ------------------------------------------------------------ the plot

    async build() {
      const { data } = this;
      const B = Bokeh;
      const isMap = data.kind === "map";
      const stage = this.box.querySelector(".live-stage");
      const [[x0, x1], [y0, y1]] = data.limits;
      const height = Math.round(
        Math.min(0.74 * innerHeight, Math.max(320, stage.clientWidth * data.aspect)),
      );
      this.wheel = new B.WheelZoomTool({ zoom_on_axis: !isMap });
      const tools = [
        new B.PanTool(), new B.BoxZoomTool({ match_aspect: isMap }), this.wheel,
        new B.ZoomInTool(), new B.ZoomOutTool(), new B.ResetTool(),
      ];
      const plot = B.Plotting.figure({
        sizing_mode: "stretch_width", height, tools,
        x_range: new B.Range1d({ start: x0, end: x1 }),
        y_range: new B.Range1d({ start: y0, end: y1 }),
        x_axis_type: data.x_log ? "log" : "auto", y_axis_type: data.y_log ? "log" : "auto",
        x_axis_label: data.x_label, y_axis_label: data.y_label,
        toolbar_location: "above", min_border_right: 12, min_border_left: 60, lod_threshold: null,
      });
      if (isMap) {
        for (const axis of [...plot.xaxes, ...plot.yaxes]) {
          axis.formatter = new B.BasicTickFormatter({ use_scientific: false }); // UTM has large ones
        }
      }
      plot.toolbar.logo = null;
      plot.toolbar.active_scroll = null; // a page that is scrolled over it must not zoom it
      this.plot = plot;
      if (data.scans || data.clouds) this.addRaster();
      for (const one of data.series) this.addSeries(one);
      this.addRobots();
      if (data.sides) {
        this.divider = new B.Span({ dimension: "height", location: x0, visible: false, line_width: 2 });
        plot.add_layout(this.divider);
      }
      this.controls();
      this.paint();
      this.view = await B.Plotting.show(plot, stage);
      if (isMap) {
        this.fit();
        for (const size of [plot.properties.inner_width, plot.properties.inner_height]) {
          size.change.connect(() => this.resized());
        }
      }
      const moved = () => this.later(() => this.draw());
      for (const range of [plot.x_range, plot.y_range]) {
        range.properties.start.change.connect(moved);
        range.properties.end.change.connect(moved);
      }
      stage.addEventListener("pointerdown", () => { this.wheel.active = true; });
      stage.addEventListener("pointerleave", () => { this.wheel.active = false; });
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
        this.paint();
        this.draw();
      });
      this.draw();
      this.box.dataset.ready = "true";
    }

    // Equal scales: the limits in the middle of the frame, whatever its size.
    fit() {
      const { plot, data } = this;
      const [[x0, x1], [y0, y1]] = data.limits;
      const scale = Math.max((x1 - x0) / plot.inner_width, (y1 - y0) / plot.inner_height);
      const half = [0.5 * scale * plot.inner_width, 0.5 * scale * plot.inner_height];
      [[plot.x_range, (x0 + x1) / 2, half[0]], [plot.y_range, (y0 + y1) / 2, half[1]]].forEach(
        ([range, middle, by]) => {
          const limits = { start: middle - by, end: middle + by };
          range.setv({ ...limits, reset_start: limits.start, reset_end: limits.end });
        },
      );
    }

    // What nobody has zoomed or moved is fitted again; not for ever, where the numbers at the axes
    // change the frame and the frame the numbers.
    resized() {
      const { x_range, y_range } = this.plot;
      const isWhole = [x_range, y_range].every(
        (range) => range.start === range.reset_start && range.end === range.reset_end,
      );
      const width = this.box.clientWidth;
      this.fits = width === this.fittedWidth ? this.fits + 1 : 0;
      this.fittedWidth = width;
      if (isWhole && this.fits < MOST_FITS) this.fit();
      else this.keepScale();
    }

    // The frame has another size (a window, longer numbers at an axis): same middle, same scale.
    keepScale() {
      const { plot } = this;
      const middle = (plot.x_range.start + plot.x_range.end) / 2;
      const half = (0.5 * plot.inner_width * (plot.y_range.end - plot.y_range.start)) / plot.inner_height;
      plot.x_range.setv({ start: middle - half, end: middle + half });
    }

    addSeries(one) {
      const columns = {};
      for (const [name, array] of Object.entries(one.columns)) columns[name] = decoded(array);
      const texts = one.texts || {};
      const starts = one.starts ? decoded(one.starts) : null;
      const lines = one.glyph === "lines" || one.glyph === "areas";
      const full = { ...texts };
      for (const [name, values] of Object.entries(columns)) {
        full[name] = starts && lines && (name === "x" || name === "y") ? split(values, starts) : values;
      }
      const source = new Bokeh.ColumnDataSource({ data: full });
      const { plot } = this;
      const of = { source, line_width: one.width, line_alpha: one.alpha };
      let renderer;
      if (one.glyph === "path") {
        renderer = plot.line({ field: "x" }, { field: "y" }, { ...of, line_dash: one.dash });
      } else if (one.glyph === "lines") {
        renderer = plot.multi_line({ field: "x" }, { field: "y" }, { ...of, line_dash: one.dash });
      } else if (one.glyph === "areas") {
        renderer = plot.patches({ field: "x" }, { field: "y" }, { ...of, fill_alpha: 0.25 });
      } else if (one.glyph === "ellipses") {
        const size = { width: { field: "width" }, height: { field: "height" }, angle: { field: "angle" } };
        renderer = plot.ellipse({ field: "x" }, { field: "y" }, size.width, size.height, {
          ...of, angle: size.angle, fill_alpha: 0,
        });
      } else {
        renderer = plot.scatter({ field: "x" }, { field: "y" }, {
          source, size: one.width, marker: one.marker, line_alpha: 0, fill_alpha: one.alpha,
        });
      }
      if (one.tip) {
        const hover = new Bokeh.HoverTool({
          renderers: [renderer], tooltips: one.tip, line_policy: "nearest", point_policy: "snap_to_data",
          visible: false, attachment: "horizontal", description: one.layer,
        });
        plot.add_tools(hover);
      }
      this.series.push({ ...one, source, renderer, full });
    }

    addRobots() {
      this.source = new Bokeh.ColumnDataSource({ data: { x: [], y: [], angle: [], color: [] } });
      this.plot.scatter({ field: "x" }, { field: "y" }, {
        source: this.source, marker: "triangle", size: 16, angle: { field: "angle" },
        fill_color: { field: "color" }, line_color: cssColor("card"), line_width: 1.5,
      });
    }

    // Colours of the page, light or dark.
    paint() {
      const { plot } = this;
      const [ink, soft, grid, card] = ["ink", "soft", "grid", "card"].map(cssColor);
      plot.setv({ background_fill_color: card, border_fill_color: card, outline_line_color: grid });
      for (const axis of [...plot.xaxes, ...plot.yaxes]) {
        axis.setv({
          axis_label_text_color: soft, major_label_text_color: ink, axis_line_color: grid,
          major_tick_line_color: grid, minor_tick_line_color: null, axis_label_text_font_style: "normal",
        });
      }
      for (const line of [...plot.xgrids, ...plot.ygrids]) line.grid_line_color = grid;
      for (const { renderer, color, glyph } of this.series) {
        const paints = { line_color: cssColor(color) };
        if (glyph === "points" || glyph === "areas") paints.fill_color = cssColor(color);
        renderer.glyph.setv(paints);
      }
      if (this.divider) this.divider.line_color = cssColor("accent");
    }

    // ------------------------------------------------------------ what is shown

    later(task) {
      if (this.waiting) return;
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        task();
      });
    }

    // World x of the divider: left of it is what was before, right of it what is after.
    border() {
      const { start, end } = this.plot.x_range;
      return this.swipe > 0 ? start + (end - start) * this.swipe : -Infinity;
    }

    draw() {
      const border = this.border();
      if (this.divider) this.divider.setv({ visible: this.swipe > 0, location: Number.isFinite(border) ? border : 0 });
      for (const one of this.series) {
        const visible = !this.hidden.has(one.layer) && (one.side !== "before" || this.swipe > 0);
        one.renderer.visible = visible;
        if (visible && (one.timed || one.side)) this.cut(one, border);
      }
      this.drawRobots(border);
      if (this.raster) this.drawRaster(border);
      if (this.data.x_log) this.mark(this.plot.xaxes, this.plot.xgrids, this.plot.x_range);
      if (this.data.y_log) this.mark(this.plot.yaxes, this.plot.ygrids, this.plot.y_range);
    }

    // Numbers along a logarithmic axis: 1, 2, 5, 10 or, over many decades, 1, 10; those of a linear
    // axis where one has zoomed so far in that none of these would be seen.
    mark(axes, grids, { start, end }) {
      const decades = Math.log10(end / start);
      const steps = decades > 2.5 ? [1] : [1, 2, 5];
      const state = decades > 0.7 ? steps.length : 0;
      if (axes[0].marked === state) return;
      axes[0].marked = state;
      const ticks = [];
      for (let k = -12; k <= 9; k += 1) for (const step of steps) ticks.push(+`${step}e${k}`);
      const ticker = state ? new Bokeh.FixedTicker({ ticks }) : new Bokeh.BasicTicker();
      for (const one of [...axes, ...grids]) one.ticker = ticker;
      // 0.0005 as on the drawings, not 5.000e-4
      for (const axis of axes) axis.formatter = new Bokeh.NumeralTickFormatter({ format: "0.[00000000]" });
    }

    // Leaves out what is later than the slider, or on the other side of the divider.
    cut(one, border) {
      const { full } = one;
      const { x, y, time } = full;
      const now = this.time;
      const inside = (value) =>
        !one.side || (one.side === "before" ? value < border : value >= border);
      const shown = (i, value) => (!time || time[i] <= now) && inside(value);
      const state = `${now}|${one.side ? border : ""}`;
      if (state === one.state) return;
      one.state = state;
      if (one.glyph === "lines" || one.glyph === "areas") {
        const gone = [NaN];
        const kept = Array.from(x, (part, i) => shown(i, (part[0] + part[part.length - 1]) / 2));
        one.source.data = {
          ...full, x: Array.from(x, (part, i) => (kept[i] ? part : gone)),
          y: Array.from(y, (part, i) => (kept[i] ? part : gone)),
        };
      } else {
        one.source.data = { ...full, x: x.map((value, i) => (shown(i, value) ? value : NaN)) };
      }
    }

    drawRobots(border) {
      const found = { x: [], y: [], angle: [], color: [] };
      for (const one of this.series) {
        if (!one.robot || !Number.isFinite(this.time) || !one.renderer.visible) continue;
        const { x, y, time, heading } = one.full;
        let i = -1;
        while (i + 1 < time.length && time[i + 1] <= this.time) i += 1;
        if (i < 0 || (one.side === "before") !== (x[i] < border)) continue;
        found.x.push(x[i]);
        found.y.push(y[i]);
        found.angle.push(heading[i] - Math.PI / 2);
        found.color.push(cssColor(one.color));
      }
      this.source.data = found;
    }

    // ------------------------------------------------------------ scans, as a picture of the view

    addRaster() {
      const { scans, clouds } = this.data;
      this.raster = { clouds: [] };
      if (scans) {
        const found = {};
        for (const name of ["time", "count", "robot", "after", "before", "points"]) found[name] = decoded(scans[name]);
        this.raster.scans = { ...found, unit: scans.unit, colors: scans.colors, layer: scans.layer };
      }
      for (const cloud of clouds || []) this.raster.clouds.push({ ...cloud, points: decoded(cloud.points) });
      this.picture = new Bokeh.ColumnDataSource({ data: { image: [], x: [], y: [], dw: [], dh: [] } });
      this.plot.image_rgba({ field: "image" }, { field: "x" }, { field: "y" }, { field: "dw" }, { field: "dh" }, {
        source: this.picture,
      });
    }

    drawRaster(border) {
      const { plot, raster } = this;
      const { start: x0, end: x1 } = plot.x_range;
      const { start: y0, end: y1 } = plot.y_range;
      const density = Math.min(devicePixelRatio || 1, 2);
      const width = Math.max(1, Math.round(plot.inner_width * density));
      const height = Math.max(1, Math.round(plot.inner_height * density));
      const scale = width / (x1 - x0);
      const dot = Math.max(1, Math.min(MAX_DOT, Math.round(MIN_DOT_M * scale)));
      const pixels = new Uint32Array(width * height);
      const bytes = new Uint8Array(pixels.buffer);
      const step = dot > 1 ? 200 : 110; // opacity of a single return
      const put = (x, y, color) => {
        const i = Math.floor((x - x0) * scale);
        const j = Math.floor((y - y0) * scale);
        if (i < 0 || j < 0 || i + dot > width || j + dot > height) return;
        for (let b = j; b < j + dot; b += 1) {
          for (let a = i; a < i + dot; a += 1) {
            const at = 4 * (b * width + a);
            bytes[at] = color[0];
            bytes[at + 1] = color[1];
            bytes[at + 2] = color[2];
            bytes[at + 3] = Math.min(255, bytes[at + 3] + step);
          }
        }
      };
      if (raster.scans && !this.hidden.has(raster.scans.layer)) this.putScans(raster.scans, border, put);
      for (const { points, unit, origin, color, layer, side } of raster.clouds) {
        if (this.hidden.has(layer)) continue;
        const paint = rgb(color);
        for (let k = 0; k < points.length; k += 2) {
          const x = origin[0] + unit * points[k];
          if (this.swipe > 0 && (side === "before") !== (x < border)) continue; // both without a swipe
          put(x, origin[1] + unit * points[k + 1], paint);
        }
      }
      const image = [Bokeh.require("core/util/ndarray").ndarray(pixels, { shape: [height, width], dtype: "uint32" })];
      this.picture.data = { image, x: [x0], y: [y0], dw: [x1 - x0], dh: [y1 - y0] };
    }

    // The points of every keyframe, from the poses of before left of the divider.
    putScans(scans, border, put) {
      const { time, count, robot, points, unit } = scans;
      const colors = scans.colors.map(rgb);
      for (const [poses, isBefore] of [[scans.after, false], [scans.before, true]]) {
        if (isBefore && !(this.swipe > 0)) continue;
        let next = 0;
        for (let k = 0; k < time.length; k += 1) {
          const begin = next;
          next += 2 * count[k];
          if (time[k] > this.time) continue;
          const c = Math.cos(poses[3 * k + 2]) * unit;
          const s = Math.sin(poses[3 * k + 2]) * unit;
          for (let i = begin; i < next; i += 2) {
            const x = poses[3 * k] + c * points[i] - s * points[i + 1];
            if (x < border === isBefore) put(x, poses[3 * k + 1] + s * points[i] + c * points[i + 1], colors[robot[k]]);
          }
        }
      }
    }

    // ------------------------------------------------------------ controls

    controls() {
      const bar = this.box.querySelector(".live-controls");
      for (const input of bar.querySelectorAll("input[data-layer]")) {
        const set = () => this.hidden[input.checked ? "delete" : "add"](input.dataset.layer);
        set();
        input.addEventListener("change", () => { set(); this.draw(); });
      }
      const swipe = bar.querySelector("input[name=swipe]");
      if (swipe) swipe.addEventListener("input", () => { this.swipe = +swipe.value / 100; this.later(() => this.draw()); });
      const clock = bar.querySelector("input[name=time]");
      if (!clock) return;
      const shown = bar.querySelector("output");
      const play = bar.querySelector("button");
      const set = () => {
        const share = +clock.value / +clock.max;
        this.time = share >= 1 ? Infinity : share * this.data.duration_s;
        const seconds = share * this.data.duration_s;
        shown.textContent = this.data.in_minutes ? `${(seconds / 60).toFixed(1)} min` : `${seconds.toFixed(1)} s`;
        this.later(() => this.draw());
      };
      const stop = () => {
        clearInterval(this.timer);
        this.timer = undefined;
        play.textContent = "▶ replay";
      };
      clock.addEventListener("input", () => { stop(); set(); });
      play.addEventListener("click", () => {
        if (this.timer !== undefined) { stop(); return; }
        if (+clock.value >= +clock.max) clock.value = 0;
        play.textContent = "❚❚ pause";
        this.timer = setInterval(() => {
          clock.value = +clock.value + (+clock.max * FRAME_MS) / (1000 * REPLAY_S);
          set();
          if (+clock.value >= +clock.max) stop();
        }, FRAME_MS);
      });
      set();
    }
  }

  // Drawn when it comes into view: a page of many figures opens as fast as one of few.
  const seen = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      seen.unobserve(target);
      target.live = new Live(target);
    }
  }, { rootMargin: "200px" });
  for (const box of document.querySelectorAll(".live")) {
    box.hidden = false;
    seen.observe(box);
  }
})();

"""The style sheet: light and dark, wide and narrow, screen and paper."""

from __future__ import annotations

__all__ = ["STYLE"]

STYLE = """
:root{color-scheme:light dark;
--paper:#fff;--card:#fff;--ink:#1c2330;--soft:#475067;--muted:#667085;--rule:#e4e7ec;--faint:#f5f6f8;
--accent:#0072b2;--good:#00795a;--warn:#9a5b00;--bad:#b3401a;--moving:#d55e00;
--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#c2659a;--c4:#d18f00;--c5:#3f9fd8;
--q0:#c3d3e3;--q1:#8fb7d6;--q2:#5596c4;--q3:#2672ab;--q4:#174f86;--q5:#0d2b57;--wall:#98a2b3}
@media (prefers-color-scheme:dark){:root{
--paper:#10141b;--card:#161b24;--ink:#e8ebf1;--soft:#bac2d0;--muted:#94a0b4;--rule:#2a3240;--faint:#1b212c;
--accent:#5bb3e8;--good:#3fcfa2;--warn:#f0b04a;--bad:#f58a5f;--moving:#f0853a;
--c0:#4aa8e0;--c1:#f0853a;--c2:#2cc79a;--c3:#e49ac2;--c4:#f2b93b;--c5:#9ad6f7;
--q0:#2b3a50;--q1:#32577f;--q2:#377ab0;--q3:#4d9fd6;--q4:#8cc7ee;--q5:#e6f5ff;--wall:#667085}}
*{box-sizing:border-box}
html{font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans","Liberation Sans",Arial,sans-serif;
-webkit-text-size-adjust:100%;scroll-padding-top:1rem}
body{margin:0;background:var(--paper);color:var(--ink);font-variant-numeric:tabular-nums}
header,.columns,footer{max-width:76rem;margin:0 auto;padding:0 clamp(1rem,3vw,2.5rem)}
header{padding-top:clamp(1.5rem,4vw,3.5rem)}
.brand{margin:0 0 .6rem;font-size:.78rem;letter-spacing:.09em;text-transform:uppercase;color:var(--muted);font-weight:600}
h1{margin:0;font-size:clamp(1.55rem,4.2vw,2.5rem);line-height:1.16;letter-spacing:-.018em;text-wrap:balance;
overflow-wrap:anywhere;font-weight:680}
.lede{margin:.7rem 0 0;color:var(--soft);max-width:46rem}
h2{margin:0 0 .5rem;font-size:1.42rem;letter-spacing:-.012em;line-height:1.25}
h3{margin:0 0 .7rem;font-size:1rem;line-height:1.35;font-weight:620}
h4{margin:1.6rem 0 .4rem;font-size:.95rem}
a{color:var(--accent);text-decoration-thickness:1px;text-underline-offset:.16em}
code,pre{font-family:ui-monospace,"SFMono-Regular",Menlo,Consolas,"Liberation Mono",monospace;font-size:.86em}
code{overflow-wrap:anywhere}
pre{margin:.6rem 0;padding:.8rem 1rem;background:var(--faint);border-radius:8px;white-space:pre-wrap;overflow-wrap:anywhere}
.columns{display:grid;grid-template-columns:minmax(0,1fr);gap:0 3rem}
main{min-width:0}
.contents{margin:2rem 0 0}
.contents ol{margin:0;padding:0;list-style:none;display:flex;flex-wrap:wrap;gap:.35rem .5rem;font-size:.86rem}
.contents a{display:block;padding:.2rem .7rem;border:1px solid var(--rule);border-radius:99px;color:var(--soft);text-decoration:none}
.contents a:hover{color:var(--accent);border-color:var(--accent)}
@media (min-width:68rem) and (not print){.columns{grid-template-columns:10.5rem minmax(0,1fr)}
.contents{margin:0}.contents ol{position:sticky;top:1.5rem;margin-top:3.1rem;flex-direction:column;gap:.1rem}
.contents a{border:0;border-left:2px solid var(--rule);border-radius:0;padding:.22rem .8rem}}
.part{padding-top:2.9rem}
.part>p{max-width:46rem;color:var(--soft);margin:.2rem 0 1rem}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,12.5rem),1fr));gap:.9rem;margin:1.8rem 0 0;padding:0;list-style:none}
.tiles li{background:var(--card);border:1px solid var(--rule);border-radius:12px;padding:.85rem 1.05rem;min-width:0}
.tiles .what{font-size:.8rem;color:var(--muted);line-height:1.35;display:block;overflow-wrap:anywhere}
.tiles .big{font-size:1.6rem;font-weight:650;letter-spacing:-.02em;display:block;margin:.15rem 0 .1rem;white-space:nowrap}
.tiles .unit{font-size:.82rem;font-weight:450;color:var(--muted);letter-spacing:0}
.tiles .more{font-size:.8rem;color:var(--soft);line-height:1.4;display:block}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,24rem),1fr));gap:1.3rem;margin-top:1.1rem}
.figure{margin:0;padding:1.1rem 1.2rem .95rem;background:var(--card);border:1px solid var(--rule);border-radius:12px;min-width:0;
break-inside:avoid}
.figure.wide{grid-column:1/-1}
.number{color:var(--muted);font-weight:500;margin-right:.3em}
figcaption{font-size:.84rem;line-height:1.5;color:var(--soft);margin-top:.6rem}
figcaption p{margin:0;max-width:52rem}
.thesis{white-space:nowrap;font-size:.93em;color:var(--muted)}
.thesis::before{content:"["}.thesis::after{content:"]"}
.chart{display:block;width:100%;max-width:40rem;height:auto;margin:0 auto;overflow:visible}
.chart text{font-size:12px;fill:var(--ink);font-variant-numeric:tabular-nums}
.chart .tick,.chart .note{fill:var(--muted);font-size:11.5px}
.chart .label{fill:var(--soft);font-size:12px}
.chart .factor{fill:var(--muted);white-space:pre}
.chart .value{fill:var(--muted);white-space:pre}
.chart .strong{font-weight:680}
.end{text-anchor:end}.middle{text-anchor:middle}
.grid{stroke:var(--rule);stroke-width:1}
.axis,.mark{stroke:var(--muted);stroke-width:1;fill:none}
.level{stroke:var(--muted);stroke-width:1;stroke-dasharray:1 3;stroke-linecap:round;fill:none}
.s0{--c:var(--c0)}.s1{--c:var(--c1)}.s2{--c:var(--c2)}.s3{--c:var(--c3)}.s4{--c:var(--c4)}.s5{--c:var(--c5)}
.truth{--c:var(--ink)}.floor0,.floor1,.floor2{--c:var(--muted)}
.m0{--c:#0072b2}.m1{--c:#d55e00}.m2{--c:#56b4e9}.m3{--c:#e69f00}
.line{fill:none;stroke:var(--c);stroke-width:1.9;stroke-linejoin:round;stroke-linecap:round}
.steps{stroke-width:1.6;stroke-linejoin:miter;stroke-linecap:butt}
.line.floor0{stroke-width:1.5;stroke-dasharray:6 4}.line.floor1{stroke-width:1.5;stroke-dasharray:1.5 4}
.line.twin{--c:var(--good);stroke-width:1.3;stroke-dasharray:8 3 2 3}
.line.d1{stroke-dasharray:7 4}.line.d2{stroke-dasharray:2 4}.line.d3{stroke-dasharray:9 3 2 3}
.line:hover{stroke-width:3.2}
.band{fill:var(--c);opacity:.15;stroke:none}
.bar{fill:var(--c)}.bar.floor0,.bar.floor1{opacity:.5}
.dots{fill:none;stroke:var(--c);stroke-width:3.2;stroke-linecap:round;opacity:.42}
.dots.on{--c:var(--ink);stroke-width:4;opacity:.55}
.key{list-style:none;display:flex;flex-wrap:wrap;gap:.15rem 1.1rem;margin:0 0 .55rem;padding:0;font-size:.84rem;line-height:1.4;color:var(--soft)}
.key li{display:flex;align-items:center;gap:.45rem;min-width:0;overflow-wrap:anywhere}
.key .swatch{width:22px;height:10px;flex:none}
.scroll{overflow-x:auto;-webkit-overflow-scrolling:touch}
.scroll:focus-visible,a:focus-visible,summary:focus-visible{outline:2px solid var(--accent);outline-offset:2px}
table{border-collapse:collapse;font-size:.88rem;line-height:1.35;width:100%}
th,td{padding:.42rem .8rem;text-align:right;border-bottom:1px solid var(--rule);vertical-align:baseline}
th:first-child,td:first-child{padding-left:0}th:last-child,td:last-child{padding-right:0}
thead th{font-weight:600;color:var(--soft);vertical-align:bottom;border-bottom:1px solid var(--muted);overflow-wrap:anywhere;min-width:5.4rem;max-width:15rem}
tbody th{font-weight:500;text-align:left}thead th:first-child{text-align:left}
.text td{text-align:left;color:var(--soft)}.text thead th{text-align:left}
.n{white-space:nowrap}
.ci{display:block;white-space:nowrap;font-size:.82em;color:var(--muted)}
.best{font-weight:700}
.metric{display:block}.unit,.sub{color:var(--muted);font-size:.86em;font-weight:400}
.sub{display:block;max-width:24rem}
tr.first th,tr.first td{background:var(--faint)}
.muted{color:var(--muted)}
.numbers{margin-top:.5rem;font-size:.86rem}
summary{cursor:pointer;color:var(--muted);font-size:.84rem}
.flags{list-style:none;margin:.9rem 0 0;padding:0;display:grid;gap:.5rem;font-size:.92rem}
.flags li{display:grid;grid-template-columns:auto minmax(0,1fr);gap:.6rem;align-items:baseline}
.flag{font-size:.74rem;font-weight:650;letter-spacing:.03em;padding:.06rem .5rem;border-radius:99px;border:1px solid currentColor;white-space:nowrap}
.ok{color:var(--good)}.warn{color:var(--warn)}.bad{color:var(--bad)}.unknown{color:var(--muted)}
.panels{display:grid;gap:.35rem .4rem;align-items:center;min-width:min-content}
.panels .side{font-size:.78rem;line-height:1.25;color:var(--soft);overflow-wrap:anywhere}
.panels .time{font-size:.78rem;color:var(--muted);text-align:center;line-height:1.25;overflow-wrap:anywhere;align-self:end}
.panel{display:block;width:100%;aspect-ratio:1;border:1px solid var(--wall);background:var(--paper);overflow:hidden}
.panel img{display:block;width:100%;height:100%;image-rendering:pixelated}
.panel img.smooth{image-rendering:auto}
.panel svg{display:block;width:100%;height:100%}
.left-moves{border-left:3px solid var(--moving)}.right-moves{border-right:3px solid var(--moving)}
.bottom-moves{border-bottom:3px solid var(--moving)}.top-moves{border-top:3px solid var(--moving)}
.panels-title{margin:1.1rem 0 .45rem;font-size:.9rem;font-weight:600}
.flow path{fill:none;stroke-width:1.5;stroke-linecap:round;stroke-linejoin:round}
.flow .q0{stroke:var(--q0)}.flow .q1{stroke:var(--q1)}.flow .q2{stroke:var(--q2)}
.flow .q3{stroke:var(--q3)}.flow .q4{stroke:var(--q4)}.flow .q5{stroke:var(--q5)}
.scale{display:flex;align-items:center;gap:.55rem;font-size:.8rem;color:var(--soft);margin:.1rem 0 .7rem;flex-wrap:wrap}
.ramp{width:9rem;height:.62rem;border-radius:2px;border:1px solid var(--rule);print-color-adjust:exact;-webkit-print-color-adjust:exact}
.ramp.diverging{background:linear-gradient(90deg,#0072b2,transparent,#d55e00)}
.ramp.sequential{background:linear-gradient(90deg,transparent,#009e73)}
.ramp.flow{background:linear-gradient(90deg,var(--q0),var(--q1),var(--q2),var(--q3),var(--q4),var(--q5))}
footer{margin-top:3.5rem;padding-top:1.2rem;padding-bottom:3rem;font-size:.84rem;color:var(--muted)}
footer p{border-top:1px solid var(--rule);padding-top:1.1rem;margin:0}
@media (max-width:34rem){.figure{padding:.9rem .85rem .8rem;border-radius:10px}th,td{padding:.4rem .55rem}
.tiles{grid-template-columns:repeat(2,minmax(0,1fr));gap:.6rem}.tiles li{padding:.7rem .8rem}.tiles .big{font-size:1.3rem}}
@media print{:root{--paper:#fff;--card:#fff;--ink:#111;--soft:#333;--muted:#666;--rule:#ddd;--faint:#f4f4f4;--accent:#111;
--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#c2659a;--c4:#d18f00;--c5:#3f9fd8;
--q0:#c3d3e3;--q1:#8fb7d6;--q2:#5596c4;--q3:#2672ab;--q4:#174f86;--q5:#0d2b57}
html{font-size:10pt}.contents,.numbers{display:none}.part{padding-top:1.4rem}.figure,.tiles li{border-color:#ddd}
h2,h3{break-after:avoid}tr{break-inside:avoid}.scroll{overflow:visible}
.figures{grid-template-columns:1fr 1fr;gap:.8rem}.panel,.flag,.bar,.band{print-color-adjust:exact;-webkit-print-color-adjust:exact}
@page{margin:14mm}}
"""
"""Style sheet of the page; it names no address."""
